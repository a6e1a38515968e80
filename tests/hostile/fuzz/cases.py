"""Small good files of every kind that the library reads, each with its reader."""

import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import trimesh

from torchgrasp import PointCloud, load_grasps, load_hand, load_mixture, read_cloud, read_scene
from torchgrasp.cloud.io.image import read_image, read_pose
from torchgrasp.cloud.io.read import save_cloud
from torchgrasp.control.adaptive.stability import load_stability
from torchgrasp.datasets import list_objects, read_entry
from torchgrasp.hand.draft import new_hand
from torchgrasp.hand.load import hands_folder
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.mesh import read_mesh
from torchgrasp.posture_model import GraspMixture, SampleSpec, load_samples, write_samples
from torchgrasp.posture_model.encoding import CODE_NAMES
from torchgrasp.report.turning.buffers import pack
from torchgrasp.report.turning.shown import read_page
from torchgrasp.values import Certificate, Contacts, Grasps


class Case(NamedTuple):
    """A file, what is good in it, and its reader."""

    path: Path
    good: bytes
    read: Callable[[Path], object]


def saved(path: Path, read: Callable[[Path], object]) -> Case:
    """Return the case of a file that is there."""
    return Case(path, path.read_bytes(), read)


def clouds(folder: Path) -> list[Case]:
    """Return clouds in every format and encoding."""
    rng = np.random.default_rng(0)
    points, normals = rng.uniform(-0.04, 0.04, (12, 3)), rng.normal(size=(12, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = PointCloud(torch.from_numpy(points), torch.from_numpy(normals), torch.tensor([0.1, -0.2, 0.7]).double())
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
    packed = b"".join(bytes([len(part) - 1]) + part for part in (plain[i : i + 32] for i in range(0, len(plain), 32)))
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
    (folder / "named.obj").write_text("mtllib a.mtl\nusemtl a\no b\ng c\n" + (folder / "a.obj").read_text())
    return [saved(path, read_mesh) for path in sorted(folder.iterdir())]


def images(folder: Path) -> list[Case]:
    """Return scenes, depth images and camera poses."""
    from PIL import Image

    depth = np.full((6, 8), 0.5)
    pose, camera = np.eye(4), np.array([8.0, 8.0, 4.0, 3.0])
    scene = {"depth": depth, "intrinsics": camera, "camera_pose": pose, "labels": np.ones((6, 8), int)}
    np.savez(folder / "scene.npz", **scene, table=[0.0, 0.0, -1.0, -0.6])
    np.savez(folder / "depth.npz", depth=depth)
    np.save(folder / "depth.npy", depth), np.save(folder / "pose.npy", pose)
    np.savetxt(folder / "pose.txt", pose)
    Image.fromarray((1000 * depth).astype(np.uint16)).save(folder / "depth.png")
    readers = {"scene": read_scene, "depth": lambda x: read_image("depth", x), "pose": lambda x: read_pose("pose", x)}
    return [saved(path, readers[path.stem]) for path in sorted(folder.iterdir())]


def urdfs(folder: Path) -> list[Case]:
    """Return a clean URDF, read as it stands; the hand of `folder` is the claw of the tests."""
    return [saved(folder / "claw.urdf", read_urdf), saved(folder / "claw.urdf", lambda x: load_hand(x.parent))]


def published(folder: Path) -> list[Case]:
    """Return a URDF that is mended, with a mesh."""
    text = (folder / "claw.urdf").read_text()
    trimesh.creation.icosahedron().apply_scale(0.011).export(folder / "tip.stl")
    mesh = '<mesh filename="package://claw/tip.stl" scale="1 1 1"/>'
    (folder / "claw.urdf").write_text(text.replace('<sphere radius="0.011"/>', mesh, 1))
    return [saved(folder / name, lambda x: new_hand(x.parent / "claw.urdf")) for name in ("claw.urdf", "tip.stl")]


def tomls(folder: Path) -> list[Case]:
    """Return the hand.toml of a hand."""
    return [saved(folder / "hand.toml", lambda x: load_hand(x.parent))]


def models(folder: Path) -> list[Case]:
    """Return grasps, mixtures, a stability model and a chunk of samples, small where they can be."""
    one, two = torch.ones(2), torch.ones(2, 3)
    contacts = Contacts(torch.rand(2, 3, 3), torch.eye(3).expand(2, 3, 3).contiguous(), torch.rand(2, 3))
    certificate = Certificate(one, one, one, one > 0, torch.ones(2, 6))
    pose, status = torch.eye(4).repeat(2, 1, 1), torch.zeros(2, dtype=torch.int64)
    direction, order = torch.eye(3)[:2], torch.arange(3).repeat(2, 1)
    Grasps(
        two, two, direction, pose, contacts, order, two, one, two, certificate, one, status, {"hand": "barrett"}
    ).save(folder / "grasps.safetensors")
    half = torch.full((1, 7), 0.5, dtype=torch.float64)
    eye = torch.eye(7, dtype=torch.float64)[None]
    mixture = GraspMixture(torch.ones(1, dtype=torch.float64), half, eye, ("j", *CODE_NAMES))
    mixture.save(folder / "mixture.safetensors")
    hand = load_hand("barrett")
    write_samples(hand, SampleSpec(20), folder / "samples")
    shutil.copy(hands_folder() / "barrett" / "stability.safetensors", folder)
    return [
        saved(folder / "grasps.safetensors", load_grasps),
        saved(folder / "mixture.safetensors", load_mixture),
        saved(folder / "stability.safetensors", lambda x: load_stability(hand, x)),
        saved(folder / "samples" / "chunk-000000.safetensors", lambda x: load_samples(x.parent).read()),
    ]


def pages(folder: Path) -> list[Case]:
    """Return a page that turns, with one grasp by two links."""
    three, eye, faces = np.eye(3), np.eye(4), pack(np.array([[0, 1, 2]]), "u4")
    mesh = {"points": pack(three), "faces": faces}
    record = {"ticks": pack(np.arange(2), "u4"), "time": pack(np.arange(2.0)), "forces": pack(np.ones((2, 3)))}
    poses = {"object": pack(np.stack([eye] * 2)), "links": pack(np.broadcast_to(eye, (2, 2, 4, 4)))}
    contents = {
        "title": "Grasps", "verdict": "held", "eye": [1.0, 0.0, 0.0], "table": "#eceae4", "cloud": pack(three),
        "others": None, "fingers": [["index", "#2f6db5"], ["middle", "#23967f"], ["thumb", "#e0762f"]],
        "hand": [mesh | {"link": 1, "color": "#a9b0ba"}],
        "surface": mesh | {"normals": pack(three), "std": pack(np.ones(3)), "colors": pack(three, "u1"), "most_mm": 3},
        "grasps": {
            "heads": ["rank", "success", "closure margin", "clearance mm", "surface std mm"],
            "rows": [["1", "97%", "0.02", "4.0", "1.0"]], "points": pack(three[None]), "normals": pack(three[None]),
            "links": pack(np.broadcast_to(eye, (1, 4, 2, 4, 4))),
        },
        "replay": mesh | record | poses,
    }  # fmt: skip
    page = f'<p></p><script type="application/json" id="data">{json.dumps(contents)}</script>'
    (folder / "view.html").write_text(page)
    return [saved(folder / "view.html", read_page)]


def manifests(folder: Path) -> list[Case]:
    """Return the manifest of a folder of objects."""
    pose = {"T_object_camera": np.eye(4).tolist()}
    cup = {"views": {"front": pose, "back": pose}, "suggested_scale": 0.5, "family": "cups", "mass_kg": 0.2}
    (folder / "manifest.json").write_text(json.dumps({"objects": {"cup": cup | {"group": "shell"}, "jug": cup}}))
    return [saved(folder / "manifest.json", lambda x: [read_entry(x.parent, name) for name in list_objects(x.parent)])]


def samples(folder: Path) -> list[Case]:
    """Return the JSON of a folder of samples."""
    write_samples(load_hand("barrett"), SampleSpec(20), folder)
    return [saved(folder / "samples.json", lambda x: load_samples(x.parent).read())]


MAKERS = (clouds, meshes, images, urdfs, published, tomls, models, pages, manifests, samples)
KINDS = {make.__name__: make for make in MAKERS}
