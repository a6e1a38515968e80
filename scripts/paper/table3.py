"""Table 3 of the paper with the objects of torchgrasp. It has how many points the filter keeps, and
how long shapes take.
"""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from benchmarks.common import timed

from torchgrasp import PointCloud, ShapeGP, fit_shape, list_objects, load_object
from torchgrasp.files import write_file
from torchgrasp.foundation.base import join
from torchgrasp.shape.conditioning import posterior_given
from torchgrasp.shape.estimate import off_surface, on_surface

POINTS = 1000
"""Points of a whole cloud, as in the paper."""
NOISE = 0.01
"""Standard deviation of the paper's observations, normalised."""
PUBLISHED = {
    "cylinder": ("Cylinder", 59, 24.51, 0.34),
    "rabbit": ("Bunny", 71, 24.15, 0.51),
    "spray": ("Spray", 61, 22.62, 0.28),
    "jug": ("Jug", 71, 16.25, 0.31),
}
"""The paper's object like ours: observed points, seconds of the filter, seconds of the shape."""


def table3(out: Path, seed: int = 0) -> None:
    """Print Table 3: points that the filter keeps of a cloud, and seconds. The seconds are those of
    the filter and of the shape given its points.

    "paper" is the filter of Sec. 3.1 on 1000 points of the whole surface and on the partial cloud.
    The most uncertain point is observed until none has a variance above the noise. "default" is
    what torchgrasp does with the partial cloud: a fixed number of points, the outline and the
    mirrored cloud.

    Args:
        out: folder of table3.json; it is made where it does not exist.
        seed: of every draw.
    """
    torch.set_num_threads(1)
    head = f"{'setting':9}{'cloud':9}{'points':>7}{'filter s':>10}{'shape s':>9}"
    print(f"{'':10}{head}   the paper's")
    rows: list[dict[str, Any]] = []
    for name in list_objects():
        thing = load_object(name)
        whole = sample_whole(thing.mesh, seed)
        part = thing.view
        as_paper = partial(fit_shape, budget="sure", support="paper", seed=seed)
        fits: dict[tuple[str, str], Callable[[], ShapeGP]] = {
            ("paper", "whole"): partial(as_paper, whole),
            ("paper", "partial"): partial(as_paper, part),
            ("default", "partial"): partial(fit_shape, part, seed=seed, table=0.0),
        }
        for (setting, cloud), fit in fits.items():
            shape, filtering = timed(fit)
            _, modelling = timed(partial(condition_again, shape))
            row = {"object": name, "setting": setting, "cloud": cloud, "points": len(shape.x)}
            rows.append(row | {"filter_s": filtering, "shape_s": modelling})
            label, points, first, second = PUBLISHED[name]
            beside = f"   {label} {points}, {first} s, {second} s" if cloud == "whole" else ""
            measured = f"{len(shape.x):7}{filtering:10.2f}{modelling:9.3f}"
            print(f"{name:10}{setting:9}{cloud:9}{measured}{beside}", flush=True)
    content = {"seed": seed, "rows": rows, "published": PUBLISHED}
    write_file(out / "table3.json", json.dumps(content, indent=1))


def sample_whole(mesh: trimesh.Trimesh, seed: int) -> PointCloud:
    """Return random points [m] of the whole surface of a mesh with its outward normals, a cloud."""
    points, faces = trimesh.sample.sample_surface(mesh, POINTS, seed=seed)[:2]
    return PointCloud(
        torch.from_numpy(np.array(points)), torch.from_numpy(np.array(mesh.face_normals[faces]))
    )


def condition_again(shape: ShapeGP) -> object:
    """Return the posterior of a shape's observations, computed anew at once; its time is measured.

    The observations are at the same places as those of the shape.
    """
    on = shape.x[shape.has_normal]
    normals = shape.predict(shape.metres(shape.x[shape.has_normal])).normal
    off = shape.x[~shape.has_normal]
    known = on_surface(on, normals, torch.full_like(on[:, 0], NOISE), NOISE)
    beside = off_surface(off, shape.predict(shape.metres(off)).distance, NOISE)
    return posterior_given(join([known, beside]), shape.kernel)
