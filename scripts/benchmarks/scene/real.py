"""Real frames: the support against the true one, and the number of objects against the true number.

The folder of frames holds frames.json and, for each frame, NAME_depth.png and perhaps
NAME_label.png. An entry of frames.json has `intrinsics`, the true `table_normal` in the camera's
frame, `camera_over_table_m` and `things`.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from benchmarks.common import Options, Row, bench
from torchgrasp import Scene


@bench("scene/real", objects=True)
def real(o: Options) -> list[Row]:
    """Return, over the frames of a folder, how many supports are right, the objects found, and the
    masks kept.
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
    errors = {name: support_error(scene, frames[name]) for name, scene in scenes.items()}
    right = sum(tilt < 2 and offset < 10 for tilt, offset in errors.values())
    worst = [max(error[k] for error in errors.values()) for k in (0, 1)]
    found = {name: (frames[name]["things"], len(scene.things)) for name, scene in scenes.items()}
    same = sum(true == seen for true, seen in found.values())
    text = ", ".join(f"{name} {true}: {seen}" for name, (true, seen) in found.items())
    kept = [share for name in names for share in kept_shares(folder, name, frames[name])]
    good = sum(share >= 0.95 for share in kept)
    support = f"{right} of {len(names)}; largest {worst[0]:.1f} degrees, {worst[1]:.1f} mm"
    return [
        Row(
            "support of real frames",
            "within 2 degrees and 10 mm, all",
            support,
            right == len(names),
            errors,
        ),
        Row(
            "objects of real frames",
            "true number: found, all equal",
            f"{same} equal; {text}",
            same == len(names),
            found,
        ),
        Row(
            "true labels given as masks; labels of table and walls are among them, and must be trimmed",
            "intersection over union >= 0.95",
            f"{good} of {len(kept)}; the others {', '.join(f'{share:.2f}' for share in kept if share < 0.95)}",
            None,
            {"shares": kept},
        ),
    ]


def read(folder: Path, name: str, kind: str) -> np.ndarray:
    """Return an image of a frame."""
    return np.asarray(Image.open(folder / f"{name}_{kind}.png"))


def support_error(scene: Scene, frame: dict[str, Any]) -> tuple[float, float]:
    """Return the tilt [deg] of the support, and the error [mm] of the camera's height above it."""
    assert scene.table is not None
    tilt = float(
        scene.table.normal.double() @ torch.tensor(frame["table_normal"], dtype=torch.float64)
    )
    height = float(scene.table.height(torch.zeros(3, dtype=torch.float64)))
    return math.degrees(math.acos(min(1.0, tilt))), 1e3 * abs(height - frame["camera_over_table_m"])


def kept_shares(folder: Path, name: str, frame: dict[str, Any]) -> list[float]:
    """Return the intersection over union of each true label and of the pixels that a scene keeps of
    the label.
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
