"""Real frames: the support against the true one, also in varied images. Also the number of objects
against the true number.

The folder of frames holds frames.json and, for each frame, NAME_depth.png and perhaps
NAME_label.png. An entry of frames.json has `intrinsics`, the true `table_normal` in the camera's
frame, `camera_over_table_m` and `things`.
"""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from scipy.ndimage import affine_transform

from benchmarks.common import Options, Row, bench
from benchmarks.scene.read import plane_error
from torchgrasp import Scene
from torchgrasp.foundation.errors import NoSupport
from torchgrasp.geometry.plane import Plane

VARIANTS = 6
"""Variants of each frame."""
VERTICAL = 45.0
"""Angle [deg] to the true normal above which a plane counts as vertical."""
ROLL = 12.0
CUT = 0.12
NOISE = 0.002
"""Greatest roll [deg] of a variant, greatest share that is cut from each side, and noise [1/m] over
the squared depth.
"""
DEGREES, MM = 2.0, 10.0
"""Bounds of the support of a frame."""
HOME = "home"
HOME_DEGREES, HOME_MM = 4.0, 20.0
"""Names of frames of homes begin so; bounds of their supports, which bow."""
FATES = ("right", "offered", "vertical", "wrong", "refused")
"""What becomes of the support in a variant."""
KEPT = 0.95
"""Intersection over union of a mask that is kept."""


@bench("scene/real", objects=True)
def real(o: Options) -> list[Row]:
    """Return rows over the real frames of a folder: how many supports are right, how many objects
    are found, and how much of given masks is kept.
    """
    folder = o.objects[0]
    if not (folder / "frames.json").exists():
        print(f"scene/real needs a folder with frames.json; {folder} has none")
        return []
    frames = json.loads((folder / "frames.json").read_text())
    names = [name for name in frames if not o.names or name in o.names]
    scenes = {
        name: Scene.from_depth(read(folder, name, "depth"), frames[name]["intrinsics"])
        for name in names
    }
    errors = {name: support_errors(x.supports[:1], frames[name])[0] for name, x in scenes.items()}
    right = sum(is_right(name, error) for name, error in errors.items())
    worst = [max(error[k] for error in errors.values()) for k in (0, 1)]
    bar = "within 2 degrees and 10 mm, in homes 4 degrees and 20 mm, all"
    text = f"{right} of {len(names)}; largest {worst[0]:.1f} degrees, {worst[1]:.1f} mm"
    support = Row("support of real frames", bar, text, right == len(names), errors)

    varied = [
        judge_variant(folder, name, frames[name], [o.seed, i, k])
        for i, name in enumerate(names)
        for k in range(VARIANTS)
    ]
    fates = ", ".join(f"{varied.count(fate)} {fate}" for fate in FATES)
    what = f"the same frames, mirrored, turned by up to {ROLL:g} degrees, cut and with noise"
    good = varied.count("right") == len(varied)
    text = f"of {len(varied)}: {fates}"
    variants = Row(what, "the same, all", text, good, {"varied": varied})

    found = {name: (frames[name]["things"], len(scene.things)) for name, scene in scenes.items()}
    same = sum(true == seen for true, seen in found.values())
    text = ", ".join(f"{name} {true}: {seen}" for name, (true, seen) in found.items())
    text = f"{same} equal; {text}"
    bar = "true number: found, all equal"
    objects = Row("objects of real frames", bar, text, same == len(names), found)

    kept = [share for name in names for share in kept_shares(folder, name, frames[name])]
    others = ", ".join(f"{share:.2f}" for share in kept if share < KEPT)
    text = f"{sum(share >= KEPT for share in kept)} of {len(kept)}; the others {others}"
    what = (
        "true labels given as masks; labels of table and walls are among them, and must be trimmed"
    )
    masks = Row(what, f"intersection over union >= {KEPT}", text, None, {"shares": kept})
    return [support, variants, objects, masks]


def read(folder: Path, name: str, kind: str) -> np.ndarray:
    """Return the image of a frame, (h, w): of kind "depth" [mm] or "label"."""
    return np.asarray(Image.open(folder / f"{name}_{kind}.png"))


def is_right(name: str, error: tuple[float, float]) -> bool:
    """Tell whether a support's `error`, its angle [deg] and height [mm], is within the bounds.

    Frames whose `name` begins with that of homes have wider bounds.
    """
    degrees, mm = (HOME_DEGREES, HOME_MM) if name.startswith(HOME) else (DEGREES, MM)
    return error[0] < degrees and error[1] < mm


def support_errors(
    supports: Sequence[Plane], frame: dict[str, Any], normal: Sequence[float] = ()
) -> list[tuple[float, float]]:
    """Return the errors (degrees, mm) of each support in the camera's frame.

    The first is its angle [deg] to the true `normal`; empty means that of the frame. The second is
    the error [mm] of the camera's height above it.
    """
    true = torch.tensor(normal or frame["table_normal"], dtype=torch.float64)
    camera = torch.zeros(3, dtype=torch.float64)
    return [plane_error(x, true, camera, frame["camera_over_table_m"]) for x in supports]


def judge_variant(folder: Path, name: str, frame: dict[str, Any], seed: list[int]) -> str:
    """Return what becomes of the true support in a random variant of a frame, as a word.

    "right": it is found first. "offered": it is found behind another one. "refused": no support is
    found. "vertical" and "wrong": it is not found, and the first support is vertical or not.
    """
    depth, intrinsics, normal = vary(folder, name, frame, np.random.default_rng(seed))
    try:
        supports = Scene.from_depth(depth, intrinsics).supports
    except NoSupport:
        return "refused"
    errors = support_errors(supports, frame, normal)
    right = [is_right(name, error) for error in errors]
    if any(right):
        return "right" if right[0] else "offered"
    return "vertical" if errors[0][0] > VERTICAL else "wrong"


def vary(
    folder: Path, name: str, frame: dict[str, Any], draw: np.random.Generator
) -> tuple[np.ndarray, list[float], list[float]]:
    """Return a random variant of a frame: (depth image [mm], intrinsics, true normal).

    The image is turned about the camera's axis, cut, perhaps mirrored, and has noise. The
    intrinsics are fx, fy, cx, cy, width and height [pixels]. The table's normal is in the camera's
    frame of the variant.
    """
    depth = read(folder, name, "depth")
    fx, fy, cx, cy = frame["intrinsics"]
    roll = math.radians(draw.uniform(-ROLL, ROLL))
    cosine, sine = math.cos(roll), math.sin(roll)
    # of (row, column), about the principal point
    turn = np.array([[cosine, -sine], [sine, cosine]])
    middle = np.array([cy, cx])
    turned = affine_transform(depth, np.c_[turn, middle - turn @ middle], order=0)
    # of (x, y, z): from the frame as it was to the turned one
    axes = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    normal = axes @ np.array(frame["table_normal"])
    rows, columns = depth.shape
    top, bottom = (draw.uniform(0, CUT, 2) * rows).astype(int)
    left, right = (draw.uniform(0, CUT, 2) * columns).astype(int)
    image = turned[top : rows - bottom, left : columns - right].astype(np.float64)
    height, width = image.shape
    intrinsics = [fx, fy, cx - left, cy - top, width, height]
    if draw.random() < 0.5:
        image = image[:, ::-1]
        intrinsics[2] = width - 1 - intrinsics[2]
        normal = normal * [-1.0, 1.0, 1.0]
    noise = NOISE / 1000 * image**2 * draw.normal(size=image.shape)  # images are in millimetres
    return (image + noise).clip(0).astype(depth.dtype), intrinsics, normal.tolist()


def kept_shares(folder: Path, name: str, frame: dict[str, Any]) -> list[float]:
    """Give a scene the true labels of a frame, and return how much of each label it keeps.

    It is the intersection over union of the label and of the pixels that the scene keeps. Without
    an image of labels the list is empty.
    """
    if not (folder / f"{name}_label.png").exists():
        return []
    labels = read(folder, name, "label").astype(np.int64)
    depth = read(folder, name, "depth")
    scene = Scene.from_depth(depth, frame["intrinsics"], labels=labels)
    true = torch.from_numpy(labels)[tuple(scene.pixels.T)]
    return [
        float((scene.labels == k).sum() / (true == k).sum())
        for k in true.unique().tolist()
        if k > 0
    ]
