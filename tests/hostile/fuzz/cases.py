"""Small good files of every kind that strangers give the library, each with its reader."""

import json
import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import trimesh

from torchgrasp import PointCloud, cloud_from_depth, load_hand, read_cloud, read_scene
from torchgrasp.app.author.draft import new_hand
from torchgrasp.cloud.pose import read_pose
from torchgrasp.cloud.read import save_cloud
from torchgrasp.cloud.safe_files import read_image_file
from torchgrasp.data import list_views, read_entries, read_entry
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.export import format_grasps, format_isaac, grasps_from_joints, read_foreign
from torchgrasp.foundation.errors import GraspFileWarning
from torchgrasp.geometry.mesh import read_mesh
from torchgrasp.hand.urdf import read_urdf


class Case(NamedTuple):
    """A file, what is good in it, and its reader."""

    path: Path
    good: bytes
    read: Callable[[Path], object]


def saved(path: Path, read: Callable[[Path], object]) -> Case:
    return Case(path, path.read_bytes(), read)


def clouds(folder: Path) -> list[Case]:
    """Return clouds in every format and encoding."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.04, 0.04, (12, 3))
    normals = rng.normal(size=(12, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = PointCloud(
        torch.from_numpy(points), torch.from_numpy(normals), torch.tensor([0.1, -0.2, 0.7]).double()
    )
    save_cloud(cloud, folder / "saved.npz"), save_cloud(cloud, folder / "saved.ply")
    trimesh.PointCloud(points).export(folder / "ascii.ply", encoding="ascii")
    trimesh.creation.icosahedron().apply_scale(0.05).export(folder / "mesh.ply")
    np.save(folder / "array.npy", points)
    np.savetxt(folder / "text.xyz", np.hstack([points, normals]))
    head = "FIELDS x y z normal_x normal_y normal_z\nSIZE 4 4 4 4 4 4\nTYPE F F F F F F\nCOUNT 1 1 1 1 1 1\n"
    head += "WIDTH 12\nHEIGHT 1\nVIEWPOINT 0 0 1 1 0 0 0\nPOINTS 12\nDATA "
    rows = np.hstack([points, normals]).astype("<f4")
    text = "\n".join(" ".join(f"{x:.6g}" for x in row) for row in rows)
    (folder / "ascii.pcd").write_text(f"{head}ascii\n{text}\n")
    (folder / "binary.pcd").write_bytes(f"{head}binary\n".encode() + rows.tobytes())
    plain = rows.T.tobytes()
    packed = b"".join(
        bytes([len(part) - 1]) + part
        for part in (plain[i : i + 32] for i in range(0, len(plain), 32))
    )
    sizes = struct.pack("<II", len(packed), len(plain))
    (folder / "packed.pcd").write_bytes(f"{head}binary_compressed\n".encode() + sizes + packed)
    return [saved(path, read_cloud) for path in sorted(folder.iterdir())]


def meshes(folder: Path) -> list[Case]:
    """Return meshes in every format, one with a material that is a file."""
    ball = trimesh.creation.icosahedron().apply_scale(0.05)
    for name in ("a.stl", "a.obj", "a.ply", "a.off"):
        ball.export(folder / name)
    ball.export(folder / "text.stl", file_type="stl_ascii")
    ball.export(folder / "text.ply", encoding="ascii")
    (folder / "named.obj").write_text(
        "mtllib a.mtl\nusemtl a\no b\ng c\n" + (folder / "a.obj").read_text()
    )
    return [saved(path, read_mesh) for path in sorted(folder.iterdir())]


def images(folder: Path) -> list[Case]:
    """Return scenes, and what the clouds of depth images are made of: image, mask, camera pose."""
    from PIL import Image

    depth = np.full((6, 8), 0.5)
    pose = np.eye(4)
    camera = np.array([8.0, 8.0, 4.0, 3.0])
    scene = {
        "depth": depth,
        "intrinsics": camera,
        "camera_pose": pose,
        "labels": np.ones((6, 8), int),
    }
    np.savez(folder / "scene.npz", **scene, table=[0.0, 0.0, -1.0, -0.6])
    np.savez(folder / "depth.npz", depth=depth)
    np.save(folder / "depth.npy", depth), np.save(folder / "pose.npy", pose)
    np.savetxt(folder / "pose.txt", pose)
    Image.fromarray((1000 * depth).astype(np.uint16)).save(folder / "depth.png")
    Image.fromarray(np.full((6, 8), 255, np.uint8)).save(folder / "mask.png")
    np.savez(folder / "mask.npz", mask=depth > 0)

    def read(path: Path) -> None:
        given = {"depth": depth, "mask": None, "pose": pose}
        given[path.stem] = (
            read_pose("pose", path) if path.stem == "pose" else read_image_file(path.stem, path)
        )
        cloud_from_depth(given["depth"], camera, given["mask"], given["pose"])

    return [
        saved(path, read_scene if path.stem == "scene" else read)
        for path in sorted(folder.iterdir())
    ]


def urdfs(folder: Path) -> list[Case]:
    """Return a clean URDF, read as it stands; the hand of `folder` is the claw of the tests."""
    return [
        saved(folder / "claw.urdf", read_urdf),
        saved(folder / "claw.urdf", lambda x: load_hand(x.parent)),
    ]


def published(folder: Path) -> list[Case]:
    """Return a URDF that is repaired, with a mesh."""
    text = (folder / "claw.urdf").read_text()
    trimesh.creation.icosahedron().apply_scale(0.011).export(folder / "tip.stl")
    mesh = '<mesh filename="package://claw/tip.stl" scale="1 1 1"/>'
    (folder / "claw.urdf").write_text(text.replace('<sphere radius="0.011"/>', mesh, 1))
    return [
        saved(folder / name, lambda x: new_hand(x.parent / "claw.urdf"))
        for name in ("claw.urdf", "tip.stl")
    ]


def tomls(folder: Path) -> list[Case]:
    return [saved(folder / "hand.toml", lambda x: load_hand(x.parent))]


def manifests(folder: Path) -> list[Case]:
    pose = {"T_object_camera": np.eye(4).tolist()}
    cup = {
        "views": {"front": pose, "back": pose},
        "suggested_scale": 0.5,
        "family": "cups",
        "mass_kg": 0.2,
    }
    (folder / "manifest.json").write_text(
        json.dumps({"objects": {"cup": cup | {"group": "shell"}, "jug": cup}})
    )

    def read(path: Path) -> None:
        for name in read_entries(path.parent):
            read_entry(path.parent, name)
        list_views(path.parent)

    return [saved(folder / "manifest.json", read)]


def foreign(folder: Path) -> list[Case]:
    """Return grasps in the formats that `torchgrasp import` reads."""
    hand = load_hand("barrett")
    grasp = load_shipped_grasp("jug", "barrett")
    (folder / "own.json").write_text(format_grasps(hand, grasp))
    row = np.concatenate([[0.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0], grasp.joints[0].numpy()])
    (folder / "multi.json").write_text(
        json.dumps({"pose": [row[:7].tolist()] * 2, "dofs": [row[7:].tolist()] * 2})
    )
    np.savez(folder / "bench.npz", grasp_qpos=row[None], pregrasp_qpos=row[None])
    (folder / "isaac.yaml").write_text(format_isaac(hand, grasp))

    def read(path: Path) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GraspFileWarning)
            grasps_from_joints(hand, *read_foreign(path, hand, hand.joint_names))

    return [saved(path, read) for path in sorted(folder.iterdir())]


MAKERS = (clouds, meshes, images, urdfs, published, tomls, manifests, foreign)
