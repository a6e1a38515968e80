"""Bodies as diverse as a household, any number of them, each with its convex parts. They are for
fits that need many shapes.

The families cycle. Sizes are drawn anew for each body, 15 to 250 mm in all. No body is decomposed:
its parts are known by construction, and its mesh is their union. Nothing fitted on them has seen a
scanned object.
"""

import dataclasses
import itertools
import json
import math
from pathlib import Path

import numpy as np
import trimesh
import tyro

from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.cloud.read import save_cloud
from torchgrasp.files import write_file
from train.forms import FORMS
from train.implements import IMPLEMENTS
from train.solids import Thing, find_rest, turn, unite
from train.things import THINGS
from train.vessels import VESSELS

TABLES = (VESSELS, FORMS, THINGS, IMPLEMENTS)
FAMILIES = {
    name: table[name]
    for names in itertools.zip_longest(*TABLES)
    for name, table in zip(names, TABLES, strict=True)
    if name is not None
}
"""Makers by family. A new one changes all bodies: the family of a body depends on their number."""
CALIBRATING = frozenset(name for k, name in enumerate(sorted(FAMILIES)) if k % 6 in (0, 1, 3))
"""Families that calibrate the model of success and support promises: no tree is fitted to their
trials.
"""
SEED = 46
"""Of all draws, beside the number of the body."""
TOPPLED = {
    *("can", "bottle", "flask", "jar", "turned", "cup", "mug", "goblet", "vase", "pitcher"),
    *("gable", "spray"),
}
"""Families that stand, but of which some bodies lie on their side."""
LYING = 0.2
"""Share of the bodies of these families that lie."""
GOLDEN_ANGLE = 137.5
"""Between the cameras of two bodies [deg], so that no side is seen twice."""


@dataclasses.dataclass(frozen=True)
class HouseholdBody:
    """A body [m] that rests on z = 0 above the origin. It has a closed mesh, and the convex parts
    that fill it.
    """

    name: str
    family: str
    mesh: trimesh.Trimesh
    parts: list[trimesh.Trimesh]


def author_household(k: int) -> HouseholdBody:
    """Return the k-th household body, the same at each call; k counts from 0.

    >>> body = author_household(12)
    >>> body.mesh.is_volume and all(part.is_convex for part in body.parts)
    True
    """
    family, thing = draw_thing(k)
    mesh, parts = unite(thing)
    pose = find_rest(mesh)
    low, high = mesh.copy().apply_transform(pose).bounds
    pose[:3, 3] -= (*(low + high)[:2] / 2, low[2])
    for body in (mesh, *parts):
        body.apply_transform(pose)
    return HouseholdBody(f"{family}_{k}", family, mesh, parts)


def family_of(k: int) -> str:
    """Return the name of the family of the k-th household body; families take turns."""
    return list(FAMILIES)[k % len(FAMILIES)]


def draw_thing(k: int) -> tuple[str, Thing]:
    """Return (family, solids) of the k-th household body, with solids [mm] not yet laid to rest."""
    family = family_of(k)
    draw = np.random.default_rng([SEED, k]).uniform
    thing = FAMILIES[family](draw)
    return family, turn(thing, "x", 90 if family in TOPPLED and draw() < LYING else 0)


def household(
    folder: tyro.conf.Positional[Path],
    count: int = len(FAMILIES),
    first: int = 0,
    highest: float = math.inf,
) -> None:
    """Write bodies as a folder of objects (`torchgrasp.data`) with one noisy view each.

    Args:
        folder: where the bodies go.
        count: number of bodies.
        first: number of the first body.
        highest: height [m] above which a body is left out.
    """
    bodies = map(author_household, itertools.count(first))
    low = (body for body in bodies if body.mesh.extents[2] <= highest)
    entries = {}
    for k, body in enumerate(itertools.islice(low, count)):
        camera = look_at(GOLDEN_ANGLE * k % 360, 20.0 + 10.0 * (k % 4), target=body.mesh)
        cloud = partial_view(body.mesh, camera, seed=k)
        place = folder / body.name
        place.mkdir(parents=True, exist_ok=True)
        content = body.mesh.export(file_type="ply")
        assert isinstance(content, bytes)
        write_file(place / "mesh.ply", content)
        save_cloud(cloud, place / "view0_noisy.ply")
        pose = {"T_object_camera": camera.tolist()}
        entries[body.name] = {"family": body.family, "views": {"view0": pose}}
    write_file(folder / "manifest.json", json.dumps({"objects": entries}))
