"""Write the files of torchgrasp's own objects into torchgrasp/data/assets, the same bytes every
time.

Run `objects` after a change of `train/object_shapes.py` or of the virtual camera; it needs the
extra `dev`.
"""

import dataclasses

import numpy as np
import trimesh

from torchgrasp import ContactSpec, load_hand, load_object, plan_grasps
from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.cloud.read import save_cloud
from torchgrasp.data.shipped import DATA, list_objects
from torchgrasp.evaluation.golden import GOLDEN, run_golden
from torchgrasp.files import write_file
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.values.specs import Simulator

VIEWS = {
    "cylinder": (20.0, 30.0),
    "jug": (60.0, 35.0),
    "rabbit": (55.0, 30.0),
    "spray": (50.0, 25.0),
}
"""Azimuth and elevation [deg] of the camera for each object."""


def objects() -> None:
    """Write mesh, convex parts and noisy view of each shipped object to torchgrasp/data/assets."""
    for name in list_objects():
        write_object(name)


def write_object(name: str) -> None:
    """Write mesh.ply, parts.npz and view.ply of one shipped object, and print their sizes."""
    from train.object_shapes import author  # needs manifold3d, which the other trainings do not

    solid, parts = author(name)
    arrays = solid.to_mesh64()
    corners = np.asarray(arrays.vert_properties)[:, :3].astype(np.float32)
    mesh = trimesh.Trimesh(corners, np.asarray(arrays.tri_verts))
    if not (mesh.is_volume and mesh.body_count == 1 and len(mesh.faces) <= 20_000):
        raise SystemExit(f"{name}: not one closed body of at most 20000 faces")
    content = mesh.export(file_type="ply", vertex_normal=False)
    assert isinstance(content, bytes)
    write_file(DATA / name / "mesh.ply", content)
    columns = {
        "corners": np.concatenate(parts).astype(np.float32),
        "counts": np.array([len(p) for p in parts], dtype=np.int32),
    }
    write_file(DATA / name / "parts.npz", lambda file: np.savez_compressed(file, **columns))
    azimuth, elevation = VIEWS[name]
    cloud = partial_view(mesh, look_at(azimuth, elevation, target=mesh))
    # the whole object is in view
    save_cloud(dataclasses.replace(cloud, frustum=None), DATA / name / "view.ply")
    print(f"{name}: {len(mesh.faces)} faces, {mesh.volume * 1e6:.0f} cm3, {len(parts)} parts")


def golden(seed: int = 0) -> None:
    """Plan the grasps of the golden set, and refuse a set whose verdicts are not the expected ones.

    Args:
        seed: of the plans.
    """
    spec = ContactSpec(table=0.0)
    for name, hand_name in sorted({(case.object, case.hand) for case in GOLDEN}):
        view = load_object(name).view
        grasps = plan_grasps(view, load_hand(hand_name), spec, starts=300, seed=seed)
        grasps.executable[0].save(DATA / name / f"{hand_name}.safetensors")
    simulators: tuple[Simulator, ...] = ("sapien", "mujoco")
    for simulator in simulators:
        for result in run_golden(simulator):
            print(simulator, result)
            if not result.right:
                wrong = f"{seed}: {result.case} is wrong in {simulator}"
                raise BadArgument("seed", wrong, "one with right verdicts")
