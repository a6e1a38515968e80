"""Table 4 and Fig. 5 of the paper with the objects of torchgrasp: what the contact planner finds."""

import itertools
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from paper.sheet import render_tile, save_sheet
from torchgrasp import (
    Contacts,
    ContactSpec,
    ShapeGP,
    Status,
    certify,
    fit_shape,
    list_objects,
    load_object,
    plan_contacts,
)
from torchgrasp.app.report.canvas import Canvas, map_colors
from torchgrasp.app.report.stills import rotated
from torchgrasp.contacts.closure_probability import closure_probability
from torchgrasp.files import write_file
from torchgrasp.geometry.linalg import farthest_points
from torchgrasp.shape.surface import Surface, extract_surface

THRESHOLDS = (0.03, 0.06, 0.10)
"""S_thresh of Eq. (12): those of Table 4 (the first) and of Table 6."""
PUBLISHED = {
    "cylinder": ("Cylinder", 797, "17.51 +- 8.03", "0.065 +- 0.064"),
    "rabbit": ("Bunny", 864, "18.31 +- 10.25", "0.0104 +- 0.029"),
    "spray": ("Spray", 986, "8.46 +- 3.25", "0.013 +- 0.32"),
    "jug": ("Jug", 914, "26.52 +- 13.58", "0.38 +- 0.75"),
}
"""The paper's object like ours: grasps out of 1000, seconds a start, quality [cm], all at 0.03."""
SHAPES: dict[str, dict[str, Any]] = {"paper": {"support": "paper"}, "default": {"table": 0.0}}
SPECS: dict[str, Callable[..., ContactSpec]] = {"paper": ContactSpec.paper, "default": ContactSpec}
"""How the paper and torchgrasp by itself see an object, and what they ask of contacts."""
TILE = (340, 330)
"""Width and height of one picture of Fig. 5 [pixels]."""
SHOWN = 4
"""Grasps of each object in Fig. 5."""
RED = "#d62728"
ARROW = 0.034
"""Length of a normal [m]; the ball at its foot has a radius of 4 mm."""


def table4(out: Path, starts: int = 1000, seed: int = 0) -> None:
    """Print Table 4: grasps out of 1000 starts, time and quality, with the paper's numbers beside
    ours.

    "paper" plans the paper's problem (Eqs. 10-14, starts on a sphere of 0.1) on the paper's
    observations of a view. "default" is what torchgrasp does by itself. Only certified grasps
    count.

    Args:
        out: folder of table4.json; it is made where it does not exist.
        starts: of the planner.
        seed: of the draw of starts.
    """
    torch.set_num_threads(1)
    head = f"{'setting':9}{'S':>5}{'grasps':>8}{'ms a start':>12}{'Q [cm]':>16}{'probability':>13}"
    print(f"{'':10}{head}   the paper's")
    rows: list[dict[str, Any]] = []
    for name in list_objects():
        for setting, given in SHAPES.items():
            shape = fit_shape(load_object(name).view, seed=seed, **given)
            for threshold in THRESHOLDS:
                spec = SPECS[setting](max_variance=threshold, table=0.0)
                row: dict[str, Any] = {"object": name, "setting": setting, "threshold": threshold}
                row |= count(shape, spec, starts, seed)
                rows.append(row)
                print(line(row), flush=True)
    content = {"starts": starts, "seed": seed, "rows": rows, "published": PUBLISHED}
    write_file(out / "table4.json", json.dumps(content, indent=1))


def count(shape: ShapeGP, spec: ContactSpec, starts: int, seed: int) -> dict[str, float]:
    """Plan contacts on a shape, and return numbers of the certified grasps by name.

    They are the number of grasps and the CPU time of a start [ms]. Then follow the mean and spread
    of their quality [cm], and the mean probability of closure.
    """
    began = time.process_time()
    plan = plan_contacts(shape, spec, starts, seed)
    milliseconds = 1e3 * (time.process_time() - began) / starts
    plan = plan[plan.status == Status.OK]
    plan = plan[certify(plan.contacts, spec).closed]
    quality = 100 * plan.quality
    likely = closure_probability(shape, plan.contacts[:200], spec, seed=seed).probability
    return {
        "grasps": len(plan),
        "milliseconds": milliseconds,
        "quality": float(quality.mean()),
        "spread": float(quality.std()),
        "probability": float(likely.mean()),
    }


def line(row: dict[str, Any]) -> str:
    """Return a row of Table 4 as a line of text; the paper's numbers are at the first threshold."""
    name, grasps, seconds, quality = PUBLISHED[row["object"]]
    beside = f"{name} {grasps}, {seconds} s, {quality}" if row["threshold"] == THRESHOLDS[0] else ""
    measured = f"{row['quality']:.3f} +- {row['spread']:.3f}"
    return (
        f"{row['object']:10}{row['setting']:9}{row['threshold']:5.2f}{row['grasps']:8}{row['milliseconds']:12.2f}"
        f"{measured:>16}{row['probability']:13.2f}   {beside}"
    )


def fig5(out: Path, starts: int = 300, seed: int = 0) -> None:
    """Draw Fig. 5: four planned grasps on each object, on the surface coloured by its standard
    deviation.

    Each object has a column of the paper's problem on the paper's shape, and one of torchgrasp's
    own. Of the certified grasps the better half counts. Of the paper's these are the more certain
    ones, of the others the more probable ones. Drawn are those unlike each other.

    Args:
        out: folder of fig5.png; it is made where it does not exist.
        starts: of the planner.
        seed: of the draw of starts.
    """
    scenes: list[tuple[str, Surface, Contacts]] = []
    for name, setting in itertools.product(list_objects(), SHAPES):
        spec = SPECS[setting](table=0.0)
        shape = fit_shape(load_object(name).view, seed=seed, **SHAPES[setting])
        plan = plan_contacts(shape, spec, starts, seed)
        contacts = plan.contacts[plan.status == Status.OK]
        contacts = contacts[certify(contacts, spec).closed]
        likely = closure_probability(shape, contacts, spec, seed=seed).probability
        better = likely
        if setting == "paper" and contacts.variance is not None:
            better = -contacts.variance.sum(1)
        shown = unlike(contacts[better >= better.median()], SHOWN)
        scenes.append((f"{name}, {setting}", extract_surface(shape, 64), shown))
        least_certain = 1e3 * shown.require_std().max()
        text = f"{len(contacts):5} certified, closure probable to {likely.mean():.2f}"
        text += f", drawn with std [mm] up to {least_certain:.1f}"
        print(f"{name:10}{setting:9}{text}", flush=True)
    most = 1e3 * max(float(surface.std_m.quantile(0.9)) for _, surface, _ in scenes)
    rows = [[draw(surface, shown[k], most) for _, surface, shown in scenes] for k in range(SHOWN)]
    captions = {(0, column): name for column, (name, *_) in enumerate(scenes)}
    save_sheet(out / "fig5.png", rows, captions, most)


def unlike(contacts: Contacts, count: int) -> Contacts:
    """Return `count` grasps whose contact sets are far from each other.

    The distance of two sets is that of Hausdorff, whichever finger takes a contact.
    """

    def hausdorff(places: Tensor, one: Tensor) -> Tensor:
        apart = torch.cdist(places, one.expand_as(places))
        return torch.maximum(apart.amin(1).amax(-1), apart.amin(2).amax(-1))

    return contacts[farthest_points(contacts.points, count, distance=hausdorff)]


def draw(surface: Surface, contacts: Contacts, most: float) -> Image.Image:
    """Return a picture of the first contact set on a surface coloured by its standard deviation.

    The colours end at `most` [mm]. The viewer stands where most of the contacts face.
    """
    vertices = surface.vertices.numpy()
    normals = surface.normals.numpy()
    points = contacts.points[0].numpy()
    outward = contacts.normals[0].numpy()
    canvas = Canvas()
    colors = map_colors(1e3 * surface.std_m.numpy() / most, "viridis")
    canvas.add_mesh(vertices, surface.faces.numpy(), colors, normals)
    canvas.add_arrows(points, outward, ARROW, (RED,) * len(points))
    eyes = [rotated((1.0, 0.0, 0.45), angle) for angle in range(0, 360, 15)]
    facing = [np.sort(outward @ eye) for eye in eyes]
    eye = eyes[int(np.argmax([f[0] + 0.5 * f[1] for f in facing]))]
    corners = np.concatenate([vertices, points + ARROW * outward])
    return render_tile(canvas, corners, eye, TILE)
