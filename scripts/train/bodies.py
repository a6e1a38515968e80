"""Bodies of known shape that are authored here: nothing fitted on them has seen a scanned object.

They are the library's own objects and random simple ones. Solid are boxes, rods that stand or lie,
eggs, bottles, tubs, pyramids and two solids that are joined. Thin are bars, plates, pens, spatulas,
rings and brackets, hollow are cups and bowls. Sizes suit one hand. Each is seen from one side by
the library's own camera, with its noise.
"""

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import trimesh

from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.cloud.read import save_cloud
from torchgrasp.data.shipped import list_objects, load_object
from torchgrasp.files import write_file

COUNTS = {
    "box": 5,
    "rod": 3,
    "lying": 2,
    "egg": 3,
    "bottle": 4,
    "tub": 2,
    "joined": 3,
    "bar": 3,
    "plate": 3,
    "pen": 3,
    "spatula": 3,
    "ring": 2,
    "cup": 4,
    "bowl": 3,
    "pyramid": 3,
    "bracket": 3,
}
"""Random bodies of each kind. New kinds come last: the draws of a kind depend on its place."""

GOLDEN_ANGLE = 137.5
"""Between the cameras of two bodies [deg], so that no side is seen twice."""


def author_folder(folder: Path) -> None:
    """Write the bodies as a folder of objects with one noisy view each (`torchgrasp.data`)."""
    solids = {name: load_object(name).mesh for name in list_objects()}
    for kind, count in COUNTS.items():
        for k in range(count):
            solids[f"{kind}_{k}"] = author_body(kind, k)
    write_bodies(folder, solids)


def write_bodies(folder: Path, solids: Mapping[str, trimesh.Trimesh]) -> None:
    """Write bodies by name, FAMILY_NUMBER, as a folder of objects with one noisy view each
    (`torchgrasp.data`).
    """
    entries = {}
    for k, (name, mesh) in enumerate(solids.items()):
        mesh.apply_translation([0.0, 0.0, -mesh.bounds[0, 2]])
        cloud = partial_view(
            mesh, look_at(GOLDEN_ANGLE * k % 360, 20.0 + 10.0 * (k % 4), target=mesh), seed=k
        )
        pose = np.eye(4)
        pose[:3, 3] = cloud.viewpoint.numpy()  # pyright: ignore[reportOptionalMemberAccess]
        (folder / name).mkdir(parents=True, exist_ok=True)
        write_file(folder / name / "mesh.ply", mesh.export(file_type="ply"))
        save_cloud(cloud, folder / name / "view0_noisy.ply")
        entries[name] = {
            "family": name.split("_")[0],
            "views": {"view0": {"T_object_camera": pose.tolist()}},
        }
    write_file(folder / "manifest.json", json.dumps({"objects": entries}))


def author_body(kind: str, k: int) -> trimesh.Trimesh:
    """Return the k-th body of a kind, always the same.

    >>> author_body("bottle", 0).is_volume
    True
    """
    makers: dict[str, Callable[[np.random.Generator], trimesh.Trimesh]] = {
        "box": lambda draw: trimesh.creation.box(
            (draw.uniform(0.03, 0.085), *draw.uniform(0.035, 0.14, 2))
        ),
        "rod": lambda draw: _rod(draw.uniform(0.018, 0.043), draw.uniform(0.06, 0.2)),
        "lying": lambda draw: _lay(_rod(draw.uniform(0.02, 0.035), draw.uniform(0.08, 0.18))),
        "egg": lambda draw: trimesh.creation.icosphere(subdivisions=3).apply_scale(
            draw.uniform(0.024, 0.05, 3)
        ),
        "bottle": _bottle,
        "tub": _tub,
        "joined": _joined,
        "bar": lambda draw: trimesh.creation.box(
            (*draw.uniform(0.015, 0.03, 2), draw.uniform(0.1, 0.18))[::-1]
        ),
        "plate": lambda draw: trimesh.creation.box(
            (*draw.uniform(0.05, 0.13, 2), draw.uniform(0.013, 0.025))
        ),
        "pen": lambda draw: _lay(_rod(draw.uniform(0.0075, 0.0125), draw.uniform(0.1, 0.17))),
        "spatula": _spatula,
        "ring": lambda draw: trimesh.creation.torus(
            draw.uniform(0.022, 0.045), draw.uniform(0.008, 0.013), 64, 24
        ),
        "bracket": _bracket,
        "cup": lambda draw: _hollow(
            draw, draw.uniform(0.026, 0.042), draw.uniform(0.06, 0.11), 0.7
        ),
        "bowl": lambda draw: _hollow(
            draw, draw.uniform(0.05, 0.075), draw.uniform(0.035, 0.06), 0.4
        ),
        "pyramid": _pyramid,
    }
    return makers[kind](np.random.default_rng([list(COUNTS).index(kind), k]))


def _rod(radius: float, height: float) -> trimesh.Trimesh:
    """Return an upright cylinder [m]."""
    return trimesh.creation.cylinder(radius, height, sections=64)


def _lay(body: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return an upright body on its side."""
    return body.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, [1, 0, 0]))


def _revolve(profile: list[tuple[float, float]]) -> trimesh.Trimesh:
    """Return the solid of revolution of (radius, height) [m]."""
    ends = [(0.0, profile[0][1]), *profile, (0.0, profile[-1][1])]
    return trimesh.creation.revolve(np.array(ends), sections=64)


def _bottle(draw: np.random.Generator) -> trimesh.Trimesh:
    """Return a bottle, round or oval: a body, a shoulder and a neck."""
    wide = draw.uniform(0.024, 0.042)
    height = draw.uniform(0.12, 0.22)
    shoulder = draw.uniform(0.45, 0.75)
    neck = wide * draw.uniform(0.35, 0.6)
    top = min(shoulder + 0.2, 0.9) * height
    body = _revolve(
        [(0.9 * wide, 0.0), (wide, 0.006), (wide, shoulder * height), (neck, top), (neck, height)]
    )
    return body.apply_scale((1.0, draw.uniform(0.65, 1.0), 1.0))


def _tub(draw: np.random.Generator) -> trimesh.Trimesh:
    """Return a tub that is filled to its rim and wider there than at its foot."""
    wide = draw.uniform(0.03, 0.047)
    height = draw.uniform(0.05, 0.11)
    return _revolve([(wide * draw.uniform(0.6, 0.85), 0.0), (wide, 0.9 * height), (wide, height)])


def _joined(draw: np.random.Generator) -> trimesh.Trimesh:
    """Return a box with a smaller box or a bar at its side: no convex body."""
    size = draw.uniform((0.035, 0.04, 0.05), (0.06, 0.08, 0.13))
    other = size * draw.uniform(0.3, 0.7, 3)
    arm = trimesh.creation.box(other) if draw.random() < 0.5 else _rod(other[0] / 2, other[2])
    arm.apply_translation(
        [0.0, (size[1] + other[1]) / 2 - 0.008, draw.uniform(-0.5, 0.5) * (size[2] - other[2])]
    )
    return trimesh.boolean.union([trimesh.creation.box(size), arm], engine="manifold")


def _spatula(draw: np.random.Generator) -> trimesh.Trimesh:
    """Return a lying handle with a broad, lower blade at its end."""
    handle = draw.uniform((0.09, 0.015, 0.015), (0.14, 0.025, 0.024))
    blade = draw.uniform((0.05, 0.04), (0.08, 0.07))
    plate = trimesh.creation.box((*blade, 0.6 * handle[2]))
    plate.apply_translation([(handle[0] + blade[0]) / 2 - 0.01, 0.0, -0.2 * handle[2]])
    return trimesh.boolean.union([trimesh.creation.box(handle), plate], engine="manifold")


def _bracket(draw: np.random.Generator) -> trimesh.Trimesh:
    """Return an upright plate with an arm at either end, as a pair of glasses has: its mass centre
    is outside.
    """
    plate = draw.uniform((0.008, 0.07, 0.03), (0.014, 0.13, 0.05))
    arm = draw.uniform((0.04, 0.008), (0.1, 0.012))
    parts = [trimesh.creation.box(plate)]
    for side in (-0.5, 0.5):
        rod = trimesh.creation.box((arm[0], arm[1], plate[2] / 2))
        rod.apply_translation([arm[0] / 2, side * (plate[1] - arm[1]), -plate[2] / 4])
        parts.append(rod)
    return trimesh.boolean.union(parts, engine="manifold")


def _hollow(draw: np.random.Generator, wide: float, height: float, least: float) -> trimesh.Trimesh:
    """Return an open vessel with a wall of 2 to 5 mm, its foot at least this share as wide as its
    rim.
    """
    foot = wide * draw.uniform(least, 1.0)
    wall = draw.uniform(0.002, 0.005)
    inner = _revolve([(foot - wall, wall), (wide - wall, height), (wide - wall, height + 0.01)])
    return trimesh.boolean.difference(
        [_revolve([(foot, 0.0), (wide, height)]), inner], engine="manifold"
    )


def _pyramid(draw: np.random.Generator) -> trimesh.Trimesh:
    """Return a blunt pyramid or cone, whose sides lean by 10 to 35 degrees."""
    height = draw.uniform(0.05, 0.09)
    lean = math.radians(draw.uniform(10.0, 35.0))
    top = draw.uniform(0.006, 0.015)
    profile = np.array(
        [(0.0, 0.0), (top + height * math.tan(lean), 0.0), (top, height), (0.0, height)]
    )
    return trimesh.creation.revolve(profile, sections=64 if draw.random() < 0.5 else 4)
