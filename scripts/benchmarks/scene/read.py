"""From a depth image of a room to its table and to the things on it."""

import dataclasses
import math
import time
from collections import Counter

import torch
from jaxtyping import Int
from torch import Tensor
from tqdm import tqdm

from benchmarks.common import Options, Row, bench
from benchmarks.scene.rooms import KINDS, Room, rooms
from torchgrasp import Scene
from torchgrasp.foundation.errors import NoSupport
from torchgrasp.geometry.plane import Plane


@dataclasses.dataclass(frozen=True)
class Understood:
    """What `Scene.from_depth` found in the depth image of a room, beside what is true.

    `degrees` and `mm` are the errors of the table's normal and height; infinite where no table is
    found. `offered` tells whether one of the supports is right. `lone` says what became of each
    thing that stands alone, by its label: "one", "split", "joined" or "missed". `extra` has (name
    of furniture, pixels) of each object that is furniture, if it has more than 100 pixels.
    `seconds` is CPU time.
    """

    degrees: float
    mm: float
    offered: bool
    lone: dict[int, str]
    extra: tuple[tuple[str, int], ...]
    seconds: float

    @property
    def right(self) -> bool:
        """Whether the table is within 2 degrees and 10 mm."""
        return self.degrees < 2 and self.mm < 10


def understand(room: Room) -> Understood:
    """Read a room's depth image without its camera pose or table; return the result beside the
    truth.
    """
    began = time.process_time()
    try:
        scene = Scene.from_depth(room.depth, room.intrinsics)
    except NoSupport:
        lone = dict.fromkeys(room.lone(), "missed")
        return Understood(math.inf, math.inf, False, lone, (), time.process_time() - began)
    seconds = time.process_time() - began
    true = room.table_in_camera
    # in the middle of the room's things
    middle = torch.linalg.inv(room.camera_pose)[:3, 3]
    errors = [plane_error(plane, true.normal, middle) for plane in scene.supports]
    labels = torch.zeros_like(room.labels)
    labels[tuple(scene.pixels.T)] = scene.labels
    extra = []
    for label in scene.things:
        mine = labels == label
        if int(mine.sum()) > 100 and int((mine & (room.labels > 0)).sum()) < 0.5 * int(mine.sum()):
            part = int(torch.bincount(room.furniture[mine], minlength=2)[1:].argmax())
            extra.append((room.parts[part], int(mine.sum())))
    lone = {k: _fate(labels, (room.labels == k) & (room.depth > 0)) for k in room.lone()}
    offered = any(degrees < 2 and mm < 10 for degrees, mm in errors)
    return Understood(*errors[0], offered, lone, tuple(extra), seconds)


def plane_error(
    plane: Plane, normal: Tensor, at: Tensor, height: float = 0.0
) -> tuple[float, float]:
    """Return the errors (degrees, mm) of a plane.

    The first is its angle [deg] to the true `normal` (3,). The second is the error [mm] of a height
    above it: that of the point `at` (3,) [m], which is truly `height` [m].
    """
    cosine = float(plane.normal.double() @ normal.double())
    found = float(plane.height(at.double()))
    return math.degrees(math.acos(min(1.0, cosine))), 1e3 * abs(found - height)


def _fate(labels: Int[Tensor, "h w"], true: Tensor) -> str:
    """Return what became of a thing: "one", "split", "joined" with something else, or "missed"."""
    count = torch.bincount(labels[true], minlength=1)
    count[0] = 0
    found = torch.nonzero(count > max(100.0, 0.05 * int(true.sum())))[:, 0]
    if len(found) != 1:
        return "split" if len(found) else "missed"
    whole = int((labels == found[0]).sum())
    return "one" if int(count[found[0]]) > 0.7 * whole else "joined"


@bench("scene/rooms")
def look_around(o: Options) -> list[Row]:
    """Measure which tables and things are found in rendered rooms, by models of four cameras.

    Rooms have edges, floors, walls, bins, shelves and tilted boards.
    """
    scenes = range(o.seed, o.seed + o.times(len(KINDS) * 8))
    seen = [
        (room, understand(room))
        for room in map(rooms, tqdm(scenes, desc="rooms", disable=None, leave=False))
    ]
    found = {
        i: (room.kind, room.sensor, dataclasses.asdict(one))
        for i, (room, one) in zip(scenes, seen, strict=True)
    }
    wrong = [f"{room.kind} {room.sensor}" for room, one in seen if not one.right]
    offered = sum(one.offered for _, one in seen)
    what = f"table, {len(seen)} rendered rooms, RealSense, Kinect v1, Azure Kinect, Zivid"
    bar = "the first one within 2 degrees and 10 mm, all"
    text = f"{len(seen) - len(wrong)} first, {offered} offered; wrong: {', '.join(wrong) or 'none'}"
    table = Row(what, bar, text, not wrong, {"rooms": found})

    fates = Counter(fate for _, one in seen for fate in one.lone.values())
    text = ", ".join(f"{fates[fate]} {fate}" for fate in ("one", "split", "joined", "missed"))
    good = fates["one"] >= 0.98 * fates.total()
    bar = "each is one thing, 98 %"
    lone = Row("lone things in the rooms", bar, text, good, {"fates": dict(fates)})

    extra = Counter(part for _, one in seen for part, _ in one.extra)
    text = ", ".join(f"{count} {part}" for part, count in sorted(extra.items())) or "none"
    what = "objects of more than 100 pixels that are no things"
    others = Row(what, "none", text, not extra, {"extra": dict(extra)})

    seconds = sorted(one.seconds for _, one in seen)
    median = seconds[len(seconds) // 2]
    text = f"median {median:.2f} s, largest {seconds[-1]:.2f} s"
    what = "depth image of 640 x 480 to scene in a room"
    took = Row(what, "<= 0.5 s, median", text, median <= 0.5, {"seconds": seconds})
    return [table, lone, others, took]
