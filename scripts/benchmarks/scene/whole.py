"""Segmentation of rendered things: a lone vessel, handle or ring is one object, two things apart
are two.
"""

import math

import numpy as np
import torch
import trimesh
from jaxtyping import Int
from torch import Tensor
from tqdm import tqdm

from benchmarks.common import Options, Row, bench
from torchgrasp.cloud.camera import INTRINSICS, look_at, render_depth
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.support_planes import SupportPlane
from torchgrasp.scene.image import DepthImage
from torchgrasp.scene.segment import segment

LONE = ("cup", "bowl", "mug", "ring", "standing ring")


def make(kind: str, rng: np.random.Generator) -> trimesh.Trimesh:
    """Return a random vessel, ring, box or cylinder [m] that stands on z = 0."""
    wall = rng.uniform(0.002, 0.005)
    radius = rng.uniform(0.03, 0.06)
    height = rng.uniform(0.05, 0.12)
    if kind == "box":
        mesh = trimesh.creation.box(rng.uniform(0.03, 0.12, 3))
    elif kind == "cylinder":
        mesh = trimesh.creation.cylinder(radius, height)
    elif "ring" in kind:
        mesh = trimesh.creation.torus(radius, rng.uniform(0.006, 0.015))
        if kind == "standing ring":
            mesh.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, [1, 0, 0]))
    else:
        radius, height = (1.4 * radius, 0.6 * height) if kind == "bowl" else (radius, height)
        s = np.linspace(0, 1, 20)
        foot = rng.uniform(0.3, 0.6) if kind == "bowl" else rng.uniform(0.7, 1.0)
        bulge = np.sqrt(1 - (1 - s) ** 2) if kind == "bowl" else s
        outer = np.stack([radius * (foot + (1 - foot) * bulge), height * s], -1)
        inner = np.stack([outer[::-1, 0] - wall, np.maximum(outer[::-1, 1], wall)], -1)
        mesh = trimesh.creation.revolve(np.concatenate([[[0, 0]], outer, inner, [[0, wall]]]))
        if kind == "mug":
            handle = trimesh.creation.torus(0.28 * height, rng.uniform(0.003, 0.006))
            handle.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, [1, 0, 0]))
            handle = handle.apply_translation([0.9 * radius, 0, height / 2])
            mesh = trimesh.util.concatenate(
                [mesh, handle.slice_plane([0.85 * radius, 0, 0], [1, 0, 0])]
            )
    mesh.apply_transform(
        trimesh.transformations.rotation_matrix(rng.uniform(0, 2 * math.pi), [0, 0, 1])
    )
    return mesh.apply_translation([0, 0, -mesh.bounds[0, 2]])


def pair(rng: np.random.Generator, azimuth: float) -> list[trimesh.Trimesh]:
    """Return two things with a gap of 15 to 40 mm; half of the second ones stand behind the first."""
    kinds = ("cup", "bowl", "mug", "box", "cylinder")
    first, second = (make(kinds[rng.integers(len(kinds))], rng) for _ in range(2))
    behind = math.radians(azimuth) + math.pi + rng.uniform(-0.5, 0.5)
    angle = behind if rng.uniform() < 0.5 else rng.uniform(0, 2 * math.pi)
    direction = np.array([math.cos(angle), math.sin(angle), 0.0])
    gap = rng.uniform(0.015, 0.04)
    corners = [mesh.convex_hull.sample(800, seed=0) for mesh in (first, second)]
    from scipy.spatial import KDTree

    tree = KDTree(corners[0][:, :2])
    for step in np.arange(0.02, 0.4, 0.002):
        if tree.query(corners[1][:, :2] + step * direction[:2])[0].min() > gap:
            second.apply_translation(step * direction)
            break
    return [first, second]


def agrees(image: DepthImage, labels: Int[Tensor, "h w"]) -> bool:
    """Return whether each thing of at least 300 seen pixels has a label of its own, and there is no
    other label.
    """
    found = segment(image, SupportPlane(Plane.horizontal(0.0)))
    true = torch.where(image.depth > 0, labels, 0)
    mine: list[int] = []
    for k in range(1, int(true.max()) + 1):
        own = found[(true == k) & (found > 0)]
        if int((true == k).sum()) < 300:
            continue
        if not len(own) or float((own == own.mode().values).double().mean()) < 0.97:
            return False
        mine.append(int(own.mode().values))
    return len(set(mine)) == len(mine) == int(found.max())


def scene(kind: str, rng: np.random.Generator) -> tuple[DepthImage, Int[Tensor, "h w"]]:
    """Return a noisy image of a random thing, or of a pair, on the table, and the true labels."""
    azimuth = rng.uniform(0, 360)
    elevation = rng.uniform(15, 70)
    distance = rng.uniform(0.5, 0.9)
    meshes = pair(rng, azimuth) if kind == "pair" else [make(kind, rng)]
    middle = torch.from_numpy(trimesh.util.concatenate(meshes).bounds.mean(0))
    pose = look_at(azimuth, elevation, distance, middle)
    depth, labels = render_depth(meshes, pose, seed=int(rng.integers(10**6)))
    return DepthImage(depth, INTRINSICS, pose), labels


@bench("scene/whole")
def whole(o: Options) -> list[Row]:
    """Return how many lone things are one object, and how many pairs are two."""
    rows: list[Row] = []
    for name, kinds, count, bar in (
        ("lone vessels, handles and rings", LONE, 500, 0.98),
        ("pairs 15 to 40 mm apart", ("pair",), 300, 0.9),
    ):
        total = o.times(count)
        steps = tqdm(range(total), desc=name, disable=None, leave=False)
        right = sum(
            agrees(*scene(kinds[k % len(kinds)], np.random.default_rng((o.seed, k)))) for k in steps
        )
        rows.append(
            Row(name, f"{bar:.0%}", f"{right} of {total}", right >= bar * total, {"right": right})
        )
    return rows
