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
    """What `Scene.from_depth` understood of a room.

    `degrees` and `mm` are the errors of the table; infinite where no table is found. `offered`
    tells whether one of the supports is right. `lone` has the fate of each lone thing: "one",
    "split", "joined" or "missed". `extra` has the furniture's name and the number of pixels of each
    other object of more than 100 pixels.
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
    """Return what is understood of a room in the camera's frame, without a hint."""
    began = time.process_time()
    try:
        scene = Scene.from_depth(room.depth, room.intrinsics)
    except NoSupport:
        lone = dict.fromkeys(room.lone(), "missed")
        return Understood(math.inf, math.inf, False, lone, (), time.process_time() - began)
    seconds = time.process_time() - began
    errors = [_table_error(plane, room) for plane in scene.supports]
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


def _table_error(plane: Plane, room: Room) -> tuple[float, float]:
    """Return the errors of a table [degrees, mm], at the middle of the room's things."""
    true = room.table_in_camera
    middle = torch.linalg.inv(room.camera_pose)[:3, 3]
    return math.degrees(math.acos(min(1.0, float(plane.normal @ true.normal)))), 1e3 * abs(
        float(plane.height(middle))
    )


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
    """Measure what is understood of rooms with edges, floors, walls, bins, shelves and boards, by
    four cameras.
    """
    scenes = range(o.seed, o.seed + o.times(len(KINDS) * 8))
    seen = [
        (room, understand(room))
        for room in map(rooms, tqdm(scenes, desc="rooms", disable=None, leave=False))
    ]
    fates = Counter(fate for _, one in seen for fate in one.lone.values())
    wrong = [f"{room.kind} {room.sensor}" for room, one in seen if not one.right]
    extra = Counter(part for _, one in seen for part, _ in one.extra)
    seconds = sorted(one.seconds for _, one in seen)
    median = seconds[len(seconds) // 2]
    offered = sum(one.offered for _, one in seen)
    found = {
        i: (room.kind, room.sensor, dataclasses.asdict(one))
        for i, (room, one) in zip(scenes, seen, strict=True)
    }
    return [
        Row(
            f"table, {len(seen)} rendered rooms, RealSense, Kinect v1, Azure Kinect, Zivid",
            "the first one within 2 degrees and 10 mm, all",
            f"{len(seen) - len(wrong)} first, {offered} offered; wrong: {', '.join(wrong) or 'none'}",
            not wrong,
            {"rooms": found},
        ),
        Row(
            "lone things in the rooms",
            "each is one thing, 98 %",
            ", ".join(f"{fates[fate]} {fate}" for fate in ("one", "split", "joined", "missed")),
            fates["one"] >= 0.98 * fates.total(),
            {"fates": dict(fates)},
        ),
        Row(
            "objects of more than 100 pixels that are no things",
            "none",
            ", ".join(f"{count} {part}" for part, count in sorted(extra.items())) or "none",
            not extra,
            {"extra": dict(extra)},
        ),
        Row(
            "depth image of 640 x 480 to scene in a room",
            "<= 0.5 s, median",
            f"median {median:.2f} s, largest {seconds[-1]:.2f} s",
            median <= 0.5,
            {"seconds": seconds},
        ),
    ]
