"""From a depth image to its table, to the object at a clicked pixel, and to all things in a room."""

import dataclasses
import itertools
import math
import time
from collections import Counter

import torch
from jaxtyping import Int
from torch import Tensor
from tqdm import tqdm

from benchmarks.common import Options, Row, bench
from benchmarks.scene.rooms import KINDS, Room, rooms
from benchmarks.scene.scenes import Picture, read_meshes, take_picture
from torchgrasp import Scene
from torchgrasp.cloud.camera import INTRINSICS
from torchgrasp.foundation.errors import BadArgument, NoSupport
from torchgrasp.geometry.plane import Plane

TABLES = ("apart", "apart", "crowded", "boxes", "close")
"""Kinds of scenes with a table, in turn."""
EMPTY = ("lone", "lone", "apart", "boxes")
"""Kinds of scenes without a table, in turn."""
LEAST_SEEN = 500
"""Measured pixels of an object that can be clicked: smaller ones are hidden, or too far to be
grasped.
"""


def read_plane(picture: Picture) -> Plane | None:
    """Return the plane in the world frame that is fitted in the camera's frame; None where it is
    refused.
    """
    try:
        table = Scene.from_depth(picture.depth, INTRINSICS).table
    except NoSupport:
        return None
    return None if table is None else table.moved(picture.camera_pose)


@bench("scene/plane", objects=True)
def plane(o: Options) -> list[Row]:
    """Measure the plane of scenes with a table, and how often a plane is found without a table."""
    meshes = read_meshes(o.objects[0])
    scenes = o.times(300)
    seed = o.seed
    errors: list[tuple[float, float]] = []
    refused = 0
    for i in tqdm(range(scenes), desc="plane", disable=None, leave=False):
        plane = read_plane(take_picture(meshes, seed + i, TABLES[i % len(TABLES)]))
        if plane is None:
            refused += 1
            continue
        tilt = math.degrees(math.acos(min(1.0, float(plane.normal[2]))))
        errors.append((tilt, 1e3 * abs(plane.offset)))
    good = sum(tilt < 1 and offset < 2 for tilt, offset in errors)
    tilts, offsets = (sorted(column) for column in zip(*errors, strict=True))
    empty = max(1, scenes // 3)
    accepted = [
        i
        for i in tqdm(range(empty), desc="no table", disable=None, leave=False)
        if read_plane(take_picture(meshes, seed + i, EMPTY[i % len(EMPTY)], table=False))
        is not None
    ]
    wrong = len(errors) - good + len(accepted)
    return [
        Row(
            f"plane of the table, {scenes} rendered scenes: apart, crowded, with big boxes, from nearby",
            "normal within 1 degree and offset within 2 mm, all",
            f"{good} of {scenes}, {refused} refused; largest {tilts[-1]:.2f} degrees, {offsets[-1]:.2f} mm",
            good == scenes,
            {"degrees": tilts, "mm": offsets, "refused": refused},
        ),
        Row(
            f"wrong planes accepted, the same scenes and {empty} without a table",
            "0",
            f"{wrong} ({len(accepted)} without a table)",
            wrong == 0,
            {"accepted": accepted},
        ),
    ]


def choose_pixel(
    picture: Picture, generator: torch.Generator
) -> tuple[int, tuple[int, int]] | None:
    """Return a random object that is seen whole in the picture, and a random pixel (u, v) within
    it; None: none is.
    """
    from scipy.ndimage import binary_erosion

    measured = picture.depth > 0
    choices: list[tuple[int, Int[Tensor, "k 2"]]] = []
    for k in picture.labels.unique().tolist():
        mine = picture.labels == k
        cut = mine[0].any() | mine[-1].any() | mine[:, 0].any() | mine[:, -1].any()
        inner = torch.nonzero(
            torch.from_numpy(binary_erosion(mine.numpy(), iterations=2)) & measured
        )
        if k and not cut and int((mine & measured).sum()) >= LEAST_SEEN and len(inner):
            choices.append((k, inner))
    if not choices:
        return None
    k, inner = choices[int(torch.randint(len(choices), (1,), generator=generator))]
    row, column = inner[int(torch.randint(len(inner), (1,), generator=generator))].tolist()
    return k, (column, row)


@bench("scene/click", objects=True)
def click(o: Options) -> list[Row]:
    """Measure the points of the object at a clicked pixel: the share that is found, and the share
    of other points.
    """
    meshes = read_meshes(o.objects[0])
    scenes = o.times(300)
    seed = o.seed
    generator = torch.Generator().manual_seed(seed)
    rows = []
    seconds = []
    pictures = (take_picture(meshes, seed + i, "apart") for i in itertools.count(1))
    with tqdm(total=scenes, desc="click", disable=None, leave=False) as progress:
        while len(rows) < scenes:
            picture = next(pictures)
            chosen = choose_pixel(picture, generator)
            if chosen is not None:
                *shares, spent = click_on(picture, *chosen)
                rows.append(shares)
                seconds.append(spent)
                progress.update()
    share, others = zip(*rows, strict=True)
    mean_share = sum(share) / scenes
    mean_others = sum(others) / scenes
    both = sum(s >= 0.95 and o <= 0.02 for s, o in zip(share, others, strict=True)) / scenes
    return [
        Row(
            f"object at a clicked pixel, {scenes} scenes of 3 to 8 objects at least 10 mm apart, mean",
            "the right object's points >= 95 %, of others <= 2 %",
            f"{mean_share:.1%}, {mean_others:.1%}; both in {both:.0%} of the scenes",
            mean_share >= 0.95 and mean_others <= 0.02,
            {"scenes": rows},
        ),
        Row(
            "depth image of 640 x 480 to labelled scene, one thread",
            "< 1.5 s",
            f"median {sorted(seconds)[scenes // 2]:.2f} s, largest {max(seconds):.2f} s",
            max(seconds) < 1.5,
            {"seconds": seconds},
        ),
    ]


def click_on(picture: Picture, label: int, pixel: tuple[int, int]) -> tuple[float, float, float]:
    """Return which share of the object's points is found, the share of other points, and the CPU
    time [s].
    """
    began = time.process_time()
    try:
        found = Scene.from_depth(picture.depth, INTRINSICS, picture.camera_pose, point=pixel)
        pixels = found.pixels[found.rows_of()]
    except BadArgument:
        pixels = torch.empty(0, 2, dtype=torch.long)
    spent = time.process_time() - began
    own = picture.labels[pixels[:, 0], pixels[:, 1]] == label
    true = int(((picture.labels == label) & (picture.depth > 0)).sum())
    return int(own.sum()) / true, int((~own).sum()) / max(1, len(own)), spent


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
