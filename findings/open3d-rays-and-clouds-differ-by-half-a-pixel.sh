#!/usr/bin/env bash
# Open3D: a depth image cast by create_rays_pinhole, then read by create_from_depth_image with the same intrinsics, gives a
# cloud that is half a pixel off: 2 mm at a distance of 1 m and a focal length of 250 pixels. The rays pass through
# (u + 0.5, v + 0.5), and the cloud is made at (u, v). With 0.5 less in cx and cy for the cloud, all points lie on the mesh.
# No help text names a pixel's centre. A round trip by project_to_depth_image cannot tell: it shares the cloud's convention.
# Packages: open3d 0.20.0, libusb-package 1.0.30.0, numpy 2.4.6; Linux on x86-64, Python 3.11.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check open3d==0.20.0 libusb-package==1.0.30.0 numpy==2.4.6
cat > "$place/try.py" << 'END'
import ctypes
from importlib.util import find_spec
from pathlib import Path

import numpy as np

# the wheel needs libusb of the system; this one comes as a package
ctypes.CDLL(str(Path(find_spec("libusb_package").origin).with_name("libusb-1.0.so")), mode=ctypes.RTLD_GLOBAL)
import open3d as o3d

WIDTH, HEIGHT, FOCAL = 320, 240, 250.0  # [pixels]
tensor = o3d.core.Tensor


def matrix(shift):
    return np.array([[FOCAL, 0, WIDTH / 2 - shift], [0, FOCAL, HEIGHT / 2 - shift], [0, 0, 1]])


ball = o3d.t.geometry.TriangleMesh.create_sphere(0.1, 80).translate([0.02, 0.03, 1.0])  # [m]
scene = o3d.t.geometry.RaycastingScene()
scene.add_triangles(ball)
rays = scene.create_rays_pinhole(tensor(matrix(0)), tensor(np.eye(4)), WIDTH, HEIGHT)
assert np.all(rays.numpy()[..., 5] == 1)  # so the length along a ray is the depth
depth = scene.cast_rays(rays)["t_hit"].numpy()
depth[~np.isfinite(depth)] = 0
image = o3d.t.geometry.Image(tensor(depth))

helps = [type(scene).create_rays_pinhole.__doc__]
helps += [kind.create_from_depth_image.__doc__ for kind in (o3d.geometry.PointCloud, o3d.t.geometry.PointCloud)]
assert not any(word in text.lower() for text in helps for word in ("0.5", "half", "pixel center", "pixel centre"))
print("open3d", o3d.__version__)
off = {}
for shift in (0.0, 0.5):
    k = tensor(matrix(shift))
    cloud = o3d.t.geometry.PointCloud.create_from_depth_image(image, k, depth_scale=1.0, depth_max=10.0)
    points = cloud.point.positions.numpy()
    (fx, _, cx), (_, fy, cy), _ = matrix(shift)
    pinhole = o3d.camera.PinholeCameraIntrinsic(WIDTH, HEIGHT, fx, fy, cx, cy)
    old = o3d.geometry.PointCloud.create_from_depth_image(o3d.geometry.Image(depth), pinhole, depth_scale=1.0)
    assert np.allclose(np.sort(np.asarray(old.points), 0), np.sort(points, 0), atol=1e-6)
    back = cloud.project_to_depth_image(WIDTH, HEIGHT, k, depth_scale=1.0, depth_max=10.0).as_tensor().numpy()[..., 0]
    assert np.array_equal(back, depth)
    hit = rays.numpy()[..., 3:][depth > 0] * depth[depth > 0][:, None]
    moved = 1000 * (points - hit)
    far = 1000 * float(scene.compute_distance(tensor(points)).numpy().max())
    off[shift] = *moved.mean(0).tolist(), far
    print(
        f"cx and cy less by {shift}: the cloud is moved by ({moved[:, 0].mean():.2f}, {moved[:, 1].mean():.2f}, "
        f"{moved[:, 2].mean():.2f}) mm, and its farthest point is {far:.2f} mm off the mesh"
    )
middle = float(depth[depth > 0].mean())  # [m]
x, y, z, far = off[0.0]
assert np.allclose([x, y], -1000 * 0.5 / FOCAL * middle, atol=0.01) and abs(z) < 1e-3 and far > 2
assert max(map(abs, off[0.5])) < 1e-2
END
"$place/bin/python" "$place/try.py"
