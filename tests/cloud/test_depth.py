from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchgrasp import Scene
from torchgrasp.cloud.depth import cloud_from_depth, read_depth
from torchgrasp.foundation.errors import (
    BadArgument,
    CloudWarning,
    MendedInput,
    SuspiciousScale,
    TooFewPoints,
)
from torchgrasp.geometry.frames import rigid, rotation_from_vector

K = torch.tensor([[600.0, 0, 30], [0, 550.0, 20], [0, 0, 1]], dtype=torch.float64)


def camera(width, height):
    """A camera of a resolution, as RealSense describes it."""
    return {
        "fx": 600.0,
        "fy": 600.0,
        "ppx": width / 2,
        "ppy": height / 2,
        "width": width,
        "height": height,
    }


def tilted_depth():
    """Depth of the plane n.p = 0.5 for n = (0.1, -0.2, 1), in closed form."""
    v, u = torch.meshgrid(torch.arange(48.0).double(), torch.arange(64.0).double(), indexing="ij")
    return 0.5 / (1 + 0.1 * (u - 30) / 600 - 0.2 * (v - 20) / 550)


def test_points_lie_on_the_plane_that_the_depth_was_made_from():
    cloud = cloud_from_depth(tilted_depth(), K)
    assert len(cloud) == 48 * 64
    plane = cloud.points @ torch.tensor([0.1, -0.2, 1.0], dtype=torch.float64)
    torch.testing.assert_close(plane, torch.full_like(plane, 0.5))
    assert cloud.points[0, 0] < 0  # the left column lies to the left
    assert cloud.viewpoint.tolist() == [0, 0, 0]


def test_the_pose_moves_points_and_viewpoint_alike():
    pose = rigid(
        rotation_from_vector(torch.tensor([0.3, -1.0, 2.0]).double()),
        torch.tensor([0.1, 0.2, -0.3]).double(),
    )
    still = cloud_from_depth(tilted_depth(), K)
    moved = cloud_from_depth(tilted_depth(), K, camera_pose=pose)
    torch.testing.assert_close(moved.points, still.points @ pose[:3, :3].T + pose[:3, 3])
    torch.testing.assert_close(moved.viewpoint, pose[:3, 3])


def test_the_frustum_goes_through_the_outermost_pixels():
    pose = rigid(
        rotation_from_vector(torch.tensor([0.3, -1.0, 2.0]).double()),
        torch.tensor([0.1, 0.2, -0.3]).double(),
    )
    cloud = cloud_from_depth(tilted_depth(), K, camera_pose=pose)
    height = ((cloud.points - cloud.viewpoint) @ cloud.frustum.T).reshape(48, 64, 4)
    assert float(height.min()) > -1e-12
    for border, side in ((height[:, 0], 0), (height[:, -1], 1), (height[0], 2), (height[-1], 3)):
        torch.testing.assert_close(
            border[:, side], torch.zeros(len(border)).double(), atol=1e-12, rtol=0
        )


def test_pixels_without_depth_or_outside_the_mask_are_left_out():
    depth = tilted_depth()
    mask = torch.zeros(48, 64, dtype=torch.bool)
    depth[0, 0] = 0.0
    depth[0, 1] = float("nan")
    depth[0, 2] = float("inf")
    assert len(cloud_from_depth(depth, K)) == 48 * 64 - 3
    mask[10:20, 5:25] = True
    assert len(cloud_from_depth(depth, K, mask)) == 200
    assert cloud_from_depth(depth.float(), K.float(), mask).points.dtype == torch.float32


@pytest.mark.parametrize("make", [np.asarray, torch.from_numpy])
def test_arrays_and_tensors_of_any_kind_give_the_same_cloud(make):
    depth = tilted_depth().numpy()
    depth[3, 4] = 0.0
    mm = np.round(1000 * depth).astype(np.uint16)
    mask = np.arange(48 * 64).reshape(48, 64) % 3 == 0
    exact = cloud_from_depth(torch.from_numpy(mm / 1000.0), K, torch.from_numpy(mask))
    for kind in (bool, np.uint8):
        for k in (make(K.numpy()), (600.0, 550.0, 30.0, 20.0), np.float32([600, 550, 30, 20])):
            cloud = cloud_from_depth(make(mm), k, make(mask.astype(kind)), np.eye(4))
            assert torch.equal(cloud.points, exact.points)
    infinite = np.where(depth > 0, depth, np.inf).astype(np.float32)
    assert torch.equal(read_depth(make(infinite), K)[0] > 0, torch.from_numpy(depth > 0))
    assert float(read_depth(make(mm.astype(np.int32)), K)[0].max()) == mm.max() / 1000


REFUSED = {
    "depth in mm": (lambda d: ((1000 * d), K), "depth.*are these mm"),
    "negative depth": (lambda d: (-d, K), "depth.*depths >= 0"),
    "a colour image": (lambda d: (d.expand(3, -1, -1), K), "depth.*of shape"),
    "8 bit depth": (lambda d: ((200 * d).to(torch.uint8), K), "depth.*uint16"),
    "mask of another size": (
        lambda d: (d, K, torch.ones(24, 32, dtype=torch.bool)),
        r"mask.*\(48, 64\)",
    ),
    "empty mask": (lambda d: (d, K, np.zeros((48, 64), dtype=np.uint8)), "mask.*no pixel"),
    "floating mask": (lambda d: (d, K, d), "mask.*bool or uint8"),
    "intrinsics of twice the size": (
        lambda d: (d, (1200.0, 1100.0, 64.0, 48.0)),
        r"intrinsics.*\(64.0, 48.0\) px",
    ),
    "intrinsics of half the size": (
        lambda d: (d, (300.0, 275.0, 16.0, 12.0)),
        "intrinsics.*same resolution",
    ),
    "depth in cm": (lambda d: (100 * d + 30, K), "depth.*are these cm.*depth_unit=0.01"),
    "depth in tens of metres": (lambda d: (d / 100, K), "depth.*depth_unit"),
    "a dict without a camera": (lambda d: (d, {"fps": 30}), "intrinsics.*a dict of fps"),
    "a dict of words": (
        lambda d: (d, {"fx": "a", "fy": 1, "cx": 1, "cy": 1}),
        "intrinsics.*fx, fy, cx and cy",
    ),
    "BOP of many images": (
        lambda d: (d, {"0": {"cam_K": [1] * 9}, "1": {}}),
        "intrinsics.*the entry of this image",
    ),
    "a width that is no number": (
        lambda d: (d, {"K": K.numpy(), "width": "64", "height": 48}),
        "positive width",
    ),
    "normalised intrinsics": (
        lambda d: (d, (0.96, 0.96, 0.5, 0.5)),
        "intrinsics.*multiply normalised",
    ),
    "a focal length in mm": (
        lambda d: (d, (1.93, 1.93, 32.0, 24.0)),
        "intrinsics.*view of 1.. degrees",
    ),
    "fx cx fy cy": (
        lambda d: (d, (600.0, 31.0, 600.0, 24.0)),
        "intrinsics.*the order fx, fy, cx, cy",
    ),
    "cx cy fx fy": (
        lambda d: (d, (31.0, 24.0, 600.0, 600.0)),
        "intrinsics.*the order fx, fy, cx, cy",
    ),
    "the second camera's projection": (
        lambda d: (d, [600, 0, 31, -30, 0, 600, 24, 0, 0, 0, 1, 0]),
        "fourth column",
    ),
    "a camera of twice the size": (
        lambda d: (d, camera(128, 96)),
        r"an image of 128 x 96 px.*|times 0\.5",
    ),
    "a camera of another ratio": (lambda d: (d, camera(85, 48)), "an image of 85 x 48 px"),
    "a region of another size": (
        lambda d: (
            d,
            {
                "K": K.ravel().tolist(),
                "roi": {"x_offset": 0, "y_offset": 0, "width": 32, "height": 24},
            },
        ),
        "an image of 32 x 24 px",
    ),
    "a region of words": (
        lambda d: (d, {"K": K.ravel().tolist(), "roi": {"x_offset": "8"}}),
        "roi and binning",
    ),
    "a region that is a list": (
        lambda d: (d, camera(64, 48) | {"roi": [1], "binning_x": -1}),
        "roi and binning",
    ),
    "a camera that is turned": (lambda d: (d, camera(48, 64)), "the transposed image"),
    "transposed intrinsics": (lambda d: (d, K.T), "intrinsics.*fx, fy"),
    "three intrinsics": (lambda d: (d, (600.0, 30.0, 20.0)), "intrinsics.*fx, fy, cx, cy"),
    "intrinsics of words": (lambda d: (d, ["f", "f", "c", "c"]), "intrinsics"),
    "NaN intrinsics": (lambda d: (d, (600.0, float("nan"), 30.0, 20.0)), "intrinsics.*nan"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_bad_image_is_refused_in_one_sentence(name):
    make, words = REFUSED[name]
    with pytest.raises(
        (BadArgument, TypeError), match=words
    ):  # TypeError: the annotations are checked in tests
        read_depth(*make(tilted_depth()))


def test_refusals():
    depth = tilted_depth()
    eye = torch.eye(4, dtype=torch.float64)
    with pytest.raises(SuspiciousScale, match="scene"):
        cloud_from_depth(depth * 80, K)
    with pytest.raises(TooFewPoints, match="3 measured"):
        cloud_from_depth(depth, K, torch.arange(48 * 64).reshape(48, 64) < 3)
    for spoilt in (
        2 * eye,
        torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0])).double(),
        eye + torch.nan,
    ):
        with pytest.raises(BadArgument, match="camera_pose"):
            cloud_from_depth(depth, K, camera_pose=spoilt)


class Ros:  # a message, whose matrix is an array
    k = K.numpy().ravel()
    width = 64
    height = 48


FORMS = {
    "matrix": K,
    "nine numbers": K.ravel().tolist(),
    "projection": torch.cat([K, torch.zeros(3, 1)], 1).numpy(),
    "twelve numbers": torch.cat([K, torch.zeros(3, 1)], 1).ravel(),
    "four numbers": (600, 550, 30, 20),
    "with the size": (600, 550, 30, 20, 64, 48),
    "CameraInfo of a region": {
        "K": (K + torch.tensor([[0, 0, 100], [0, 0, 50], [0, 0, 0]])).ravel().tolist(),
        "width": 640,
        "height": 480,
        "roi": {"x_offset": 100, "y_offset": 50, "width": 64, "height": 48, "do_rectify": False},
    },
    "CameraInfo of binned pixels": {
        "k": (torch.diag(torch.tensor([2.0, 2.0, 1.0]).double()) @ K).ravel().tolist(),
        "width": 128,
        "height": 96,
        "binning_x": 2,
        "binning_y": 2,
        "roi": {"x_offset": 0, "y_offset": 0, "width": 0, "height": 0},
    },
    "message of a binned region": SimpleNamespace(
        k=[1200.0, 0, 68, 0, 1100, 46, 0, 0, 1],
        width=640,
        height=480,
        binning_x=2,
        binning_y=2,
        roi=SimpleNamespace(x_offset=8, y_offset=6, width=128, height=96),
    ),
    "CameraInfo of ROS 1": {"K": K.ravel().tolist(), "width": 64, "height": 48, "D": [0.0] * 5},
    "message of ROS 2": Ros(),
    "calibration of ROS": {
        "image_width": 64,
        "image_height": 48,
        "camera_matrix": {"rows": 3, "cols": 3, "data": K.ravel().tolist()},
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5},
    },
    "Open3D": {"width": 64, "height": 48, "intrinsic_matrix": K.T.ravel().tolist()},
    "RealSense": {
        "fx": 600.0,
        "fy": 550.0,
        "ppx": 30.0,
        "ppy": 20.0,
        "width": 64,
        "height": 48,
        "coeffs": [0.0] * 5,
    },
    "Zivid": {
        "CameraIntrinsics": {"CameraMatrix": {"CX": 30.0, "CY": 20.0, "FX": 600.0, "FY": 550.0}}
    },
    "BOP": {"cam_K": K.ravel().tolist(), "depth_scale": 1.0},
    "BOP of a camera": {
        "cx": 30,
        "cy": 20,
        "fx": 600,
        "fy": 550,
        "depth_scale": 1.0,
        "width": 64,
        "height": 48,
    },
}


@pytest.mark.parametrize("name", FORMS)
def test_every_form_of_intrinsics_gives_the_same_cloud(name):
    mm = (1000 * tilted_depth()).numpy().astype(np.uint16)
    assert torch.equal(cloud_from_depth(mm, FORMS[name]).points, cloud_from_depth(mm, K).points)


@pytest.mark.parametrize(
    ("scale", "camera"),
    [
        (0.1, {"cam_K": K.ravel().tolist(), "depth_scale": 0.1}),
        (0.1, {"fx": 600, "fy": 550, "ppx": 30, "ppy": 20, "depth_scale": 1e-4}),
        (0.1, {"intrinsic_matrix": K.T.ravel().tolist(), "depth_scale": 1e4}),
        (0.2, {"fx": 600, "fy": 550, "cx": 30, "cy": 20, "factor_depth": 5000}),
        (0.25, K),
    ],
)
def test_counts_of_a_stated_unit_are_metres(scale, camera):
    counts = (1000 / scale * tilted_depth()).round().numpy().astype(np.uint16)
    unit = scale / 1000 if scale == 0.25 else None
    assert np.allclose(read_depth(counts, camera, depth_unit=unit)[0], tilted_depth(), atol=2e-4)
    floats = (1000 * tilted_depth()).float()[
        ..., None
    ]  # millimetres, as Zivid gives them, and one channel
    assert np.allclose(read_depth(floats, K, depth_unit=0.001)[0], tilted_depth(), atol=1e-6)


def test_saturated_pixels_and_a_far_plane_are_not_measured():
    mm = (1000 * tilted_depth()).numpy().astype(np.uint16)
    mm[:20] = 65535
    far = np.where(mm == 65535, 1e10, mm / 1000).astype(np.float32)  # a renderer's background
    for image in (mm, far):
        read = read_depth(image, K)[0]
        assert not read[:20].any() and bool((read[20:] > 0).all())
    thing = np.full(mm.shape, 1e10, dtype=np.float32)  # a small object, rendered alone
    thing[:2] = 0.5
    read = read_depth(thing, K)[0]
    assert bool((read[:2] == 0.5).all()) and not read[2:].any()


MODES = ((640, 480), (848, 480), (1280, 720), (1944, 1200), (512, 424))


@pytest.mark.parametrize("size", MODES)
def test_intrinsics_of_a_mode_are_refused_for_another(size):
    k = (600.0, 602.0, 0.51 * size[0], 0.49 * size[1])
    for width, height in MODES:
        if (width, height) == size:
            read_depth(np.full((height, width), 500, dtype=np.uint16), k)
        else:
            with pytest.raises(BadArgument, match="same resolution"):
                read_depth(np.full((height, width), 500, dtype=np.uint16), k)


@pytest.mark.parametrize("scale", [7.5, 3.75, 5.3, 0.3])
def test_intrinsics_of_an_image_of_any_other_scale_are_refused_with_the_factor(scale):
    """Of a colour image beside a depth image, such as that of a phone."""
    k = (213.0 * scale, 213.0 * scale, 129.6 * scale, 94.2 * scale)
    with pytest.raises(BadArgument, match=r"all four times ") as refused:
        read_depth(np.full((192, 256), 500, dtype=np.uint16), k)
    factor = float(str(refused.value).split("all four times ")[1].split(";")[0])
    assert factor * scale == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize("size", [(480, 600), (440, 640), (420, 560)])
def test_a_crop_whose_principal_point_was_kept_is_told(size):
    image = np.full(size, 0.5)
    with pytest.warns(CloudWarning, match="the middle of 640 x 480 px.*is a crop"):
        read_depth(image, (616.0, 616.0, 319.5, 239.5))
    # warnings are errors: nothing is told of the crop's own size, point, or of a camera's image
    height, width = size
    read_depth(image, (616.0, 616.0, 319.5, 239.5, width, height))
    read_depth(image, (616.0, 616.0, (width - 1) / 2 + 3, (height - 1) / 2 - 2))
    read_depth(np.full((480, 640), 0.5), (616.0, 616.0, 338.0, 229.0))


def test_a_crop_with_its_own_principal_point_is_no_other_resolution():
    rng = np.random.default_rng(0)
    depth = np.full((480, 640), 500, dtype=np.uint16)
    refused = 0
    for _ in range(200):
        (left, right), (top, bottom) = (
            np.sort(rng.integers(0, 640, 2)),
            np.sort(rng.integers(0, 480, 2)),
        )
        if min(right - left, bottom - top) < 40:
            continue
        part = depth[top:bottom, left:right]
        k = (613.0, 613.0, 322.5 - left, 248.2 - top)
        read_depth(part, (*k, right - left, bottom - top))  # stated
        try:
            read_depth(part, k)
        except BadArgument:  # as of a smaller camera, by chance
            refused += 1
        if (
            max(abs(left - (640 - right)), abs(top - (480 - bottom))) > 60
        ):  # the sensor's size, with a shifted centre
            whole = {"fx": 613, "fy": 613, "cx": k[2], "cy": k[3], "width": 640, "height": 480}
            if max(abs(k[2] / 640 - 0.5), abs(k[3] / 480 - 0.5)) > 0.05:
                read_depth(part, whole)
    assert refused < 8


RECTIFIED = [*K[0].tolist(), 0.0, *K[1].tolist(), 0.0, *K[2].tolist(), 0.0]
SIDES = {"width": 64, "height": 48}


@pytest.mark.parametrize(
    "camera",
    [
        {"k": [0.0] * 9, "d": [], "p": RECTIFIED, **SIDES},  # a node that only rectifies
        {"p": RECTIFIED, **SIDES},
        {"K": K.ravel().tolist(), "D": [0.0] * 5, "P": RECTIFIED, **SIDES},
        {"k": K.ravel().tolist(), "d": [1e-5] * 5, "p": [0.0] * 12, **SIDES},
        SimpleNamespace(k=[0.0] * 9, d=[], p=RECTIFIED, **SIDES),
    ],
)
def test_the_projection_of_a_camera_info_is_read(camera):
    right = cloud_from_depth(tilted_depth(), K)
    assert torch.allclose(cloud_from_depth(tilted_depth(), camera).points, right.points)


@pytest.mark.parametrize(
    ("camera", "told"),
    [
        ({"k": K.ravel().tolist(), "p": [0.9 * RECTIFIED[0], *RECTIFIED[1:]]}, "beside another P"),
        (
            {"k": K.ravel().tolist(), "d": [-0.2, 0.1, 0.0, 0.0, 0.0], "p": RECTIFIED},
            "with distortion D",
        ),
        (
            {
                "camera_matrix": {"data": K.ravel().tolist()},
                "distortion_coefficients": {"data": [-0.2, 0.1, 0.0, 0.0, 0.0]},
                "projection_matrix": {"data": RECTIFIED},
            },
            "with distortion D",
        ),
    ],
)
def test_a_camera_info_of_two_images_that_differ_is_told(camera, told):
    with pytest.raises(BadArgument, match=f"intrinsics: .*of a rectified image, P.*{told}"):
        cloud_from_depth(tilted_depth(), {**camera, **SIDES})


SIZE = (48, 64)
PINHOLE = np.array([[60.0, 0.0, 33.0], [0.0, 55.0, 22.0], [0.0, 0.0, 1.0]])
PLUMB = {"k1": -0.2, "k2": 0.06, "p1": 0.004, "p2": -0.003, "k3": -0.01}
RATIONAL = {**PLUMB, "k1": 0.9, "k2": 0.3, "k4": 1.1, "k5": 0.35, "k6": 0.02}
ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def bend(ray, c):
    """Where a ray meets the image plane at depth 1, as ROS's image_pipeline writes it."""
    x, y = ray
    c = {name: c.get(name, 0.0) for name in ORDER}
    r2 = x**2 + y**2
    above = 1 + c["k1"] * r2 + c["k2"] * r2**2 + c["k3"] * r2**3
    radial = above / (1 + c["k4"] * r2 + c["k5"] * r2**2 + c["k6"] * r2**3)
    return np.array(
        [
            x * radial + 2 * c["p1"] * x * y + c["p2"] * (r2 + 2 * x**2),
            y * radial + c["p1"] * (r2 + 2 * y**2) + 2 * c["p2"] * x * y,
        ]
    )


def raw_camera(form, c):
    """The description of a raw camera in the form of a driver."""
    listed = [c[name] for name in ORDER if name in c]
    numbers = {"fx": 60.0, "fy": 55.0}
    middle = {"cx": 33.0, "cy": 22.0}
    model = "rational_polynomial" if "k4" in c else "plumb_bob"
    k = PINHOLE.ravel().tolist()
    return {
        "ROS": {"k": k, "d": listed, "distortion_model": model, "p": [0.0] * 12},
        "message": SimpleNamespace(k=k, d=listed, distortion_model=model),
        "OpenCV": {"camera_matrix": {"data": k}, "distortion_coefficients": {"data": listed}},
        "RealSense": {
            **numbers,
            "ppx": 33.0,
            "ppy": 22.0,
            "model": "distortion.brown_conrady",
            "coeffs": listed,
        },
        "Zivid": {
            "CameraIntrinsics": {
                "CameraMatrix": {"FX": 60.0, "FY": 55.0, "CX": 33.0, "CY": 22.0},
                "Distortion": {name.upper(): x for name, x in c.items()},
            }
        },
        "Azure": {**numbers, **middle, "codx": 0.0, "cody": 0.0, **c},
        "JSON": {"K": k, "dist": [listed], "distortion_corrected": False},
        "Kalibr": {
            **numbers,
            **middle,
            "camera_model": "pinhole",
            "distortion_model": "radtan",
            "distortion_coeffs": listed,
        },
    }[form]


@pytest.mark.parametrize(
    "form", ["ROS", "message", "OpenCV", "RealSense", "Zivid", "Azure", "JSON", "Kalibr"]
)
@pytest.mark.parametrize("c", [PLUMB, RATIONAL])
def test_the_rays_of_a_raw_image_bend_to_its_pixels(form, c):
    depth = np.random.default_rng(0).uniform(0.4, 0.5, SIZE)
    with pytest.warns(MendedInput, match="distortion"):
        cloud = cloud_from_depth(depth, raw_camera(form, c))
    x, y, z = cloud.points.numpy().T
    assert np.allclose(z, depth.ravel())
    u, v = bend((x / z, y / z), c)
    row, column = (index.ravel() for index in np.indices(SIZE))
    assert np.abs(60 * u + 33 - column).max() < 1e-2
    assert np.abs(55 * v + 22 - row).max() < 1e-2
    # far from what the pinhole alone gives
    straight = cloud_from_depth(depth, torch.tensor(PINHOLE)).points.numpy()
    assert np.abs(straight - cloud.points.numpy()).max() > 0.005
    # the borders of the view, up to their curvature
    height = (cloud.points @ cloud.frustum.T).reshape(*SIZE, 4)
    borders = (height[24, 0, 0], height[24, -1, 1], height[0, 32, 2], height[-1, 32, 3])
    assert max(abs(float(x)) for x in borders) < 1e-4


@pytest.mark.parametrize(
    ("extra", "told"),
    [
        ({"d": [0.1, 0.0, 0.0, 0.0], "distortion_model": "equidistant"}, "model equidistant"),
        ({"d": [0.1, 0.0, 0.0, 0.0], "distortion_model": "fisheye"}, "model fisheye"),
        ({"coeffs": [0.1] * 5, "model": "Inverse Brown Conrady"}, "model inverse_brown_conrady"),
        ({"coeffs": [0.1] * 5}, "of no model"),
        ({"k1": 0.1, "camera_model": "OPENCV_FISHEYE"}, "model opencv_fisheye"),
        ({"RadialDistortion": [0.1, 0.0]}, "radialdistortion [0.1, 0.0], which is not read"),
        ({"d": [0.1] * 12}, "at most k1 k2 p1 p2 k3 k4 k5 k6"),
        ({"d": [0.1, 0.2]}, "at most k1"),
        ({"k1": 0.1, "codx": 0.01}, "at most k1"),
        ({"d": [-9.0, 0.0, 0.0, 0.0]}, "folds at"),
        ({"d": [float("nan"), 0.0, 0.0, 0.0]}, "at most k1"),
    ],
)
def test_other_distortions_are_refused_by_name(extra, told):
    camera = {"k": PINHOLE.ravel().tolist(), **extra}
    with pytest.raises(BadArgument, match="intrinsics") as error:
        cloud_from_depth(np.full(SIZE, 0.5), camera)
    assert told in str(error.value)


def test_a_raw_image_of_a_scene_is_refused():
    with pytest.raises(BadArgument, match="a rectified image"):
        Scene.from_depth(np.full(SIZE, 0.5), raw_camera("ROS", PLUMB))


def test_a_swapped_principal_point_is_named():
    depth = np.full((480, 640), 0.5)
    for camera in (
        (600.0, 600.0, 238.0, 322.0),
        {"k": [600.0, 0, 238.0, 0, 600.0, 322.0, 0, 0, 1.0], "width": 640, "height": 480},
    ):
        with pytest.raises(BadArgument, match="cx of the column before cy of the row"):
            cloud_from_depth(depth, camera)


def test_a_mask_of_several_numbers_is_told():
    mask = torch.zeros(48, 64, dtype=torch.uint8)
    mask[5:20] = 255
    whole = cloud_from_depth(tilted_depth(), K, mask)
    mask[19, ::3] = torch.arange(1, 23, dtype=torch.uint8)  # as at the border of a scaled mask
    cloud_from_depth(tilted_depth(), K, mask)
    mask[10:20] = 128
    with pytest.warns(CloudWarning, match="mask: numbers from 128 to 255 count as one object"):
        assert len(cloud_from_depth(tilted_depth(), K, mask)) == len(whole)


def test_depths_that_end_at_one_are_told():
    depth = tilted_depth()
    cloud_from_depth(depth, K)
    depth[:, 50:] = 1.0
    with pytest.warns(CloudWarning, match="22% of the depths are exactly 1"):
        cloud_from_depth(depth, K)
    cloud_from_depth(depth, K, depth_unit=1.0)  # whose user says metres is believed


@pytest.mark.parametrize("step", [0.01, 4.0 / 255])
def test_depths_of_large_steps_are_told(step):
    """Centimetres as 8-bit grey values, of 4 m for example, lose the edges of things."""
    rows = np.linspace(0.5, 0.9, 60)[:, None] + np.zeros((60, 80))
    fine = np.round(rows, 3)
    coarse = step * np.round(rows / step)
    camera = (70.0, 70.0, 39.5, 29.5)
    cloud_from_depth(fine, camera)
    with pytest.warns(CloudWarning, match=rf"depth: its steps are {1000 * step:.3g} mm"):
        cloud_from_depth(coarse, camera)


@pytest.mark.parametrize("ratio", [0.75, 1.3])
def test_pixels_that_are_not_square_are_told(ratio):
    depth = np.full((60, 80), 0.5)
    with pytest.warns(CloudWarning, match=rf"fx is {ratio:g} times fy, .* resized unevenly"):
        cloud_from_depth(depth, (ratio * 70.0, 70.0, 39.5, 29.5))
    cloud_from_depth(depth, (1.02 * 70.0, 70.0, 39.5, 29.5))


@pytest.mark.parametrize("kind", [torch.clone, np.array])
def test_a_pose_and_intrinsics_that_change_later_do_not_change_what_was_read(kind):
    pose = kind(torch.eye(4).double())
    matrix = kind(K)
    cloud = cloud_from_depth(tilted_depth(), matrix, camera_pose=pose)
    scene_matrix = read_depth(tilted_depth(), matrix)[1]
    pose[0, 3] = 0.4
    matrix[0, 0] = 300.0
    assert cloud.viewpoint.tolist() == [0, 0, 0]
    assert torch.equal(scene_matrix, K)
