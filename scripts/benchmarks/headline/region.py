"""What it costs to plan with all contacts in a given region. The best grasp of such a plan stands
beside the best one of a free plan.

The region is chosen from the cloud before planning. For every second object it is the upper half of
the cloud's bounding box. For the others it is the half of its longer horizontal side with fewer
points, like a handle. Both reach over the unseen depth. The objects lie where they were seen. An
object without a grasp fails.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from paper.tables6_7 import format_points
from paper.trials import CELL_SECONDS, Subject, TableSpec, read_solid, subjects
from train.trials import half_of

from benchmarks.common import Options, Row, bench, keep, run_all, timed
from benchmarks.headline.left_out import LEFT_OUT
from benchmarks.headline.predictions import table_spec
from torchgrasp import (
    ContactSpec,
    Grasps,
    PointCloud,
    Region,
    Status,
    close_hand,
    fit_shape,
    load_hand,
    plan_grasps,
)
from torchgrasp.evaluation import PROTOCOLS
from torchgrasp.evaluation.intervals import contrast_over, count_by, format_share, share_over
from torchgrasp.evaluation.protocols import seed_of
from torchgrasp.shape.surface import surface_field

DENSITY = 500.0
LIGHTEST = 0.05
HEAVIEST = 1.2
"""Density [kg/m^3] of objects of unknown mass: half full, hollow, or of wood; bounds of it [kg]."""


@bench("headline/region", objects=True)
def region(o: Options) -> list[Row]:
    """Close the best grasp of a free plan and of one in a region, one object of each family."""
    spec = table_spec(dataclasses.replace(o, names=o.names or LEFT_OUT), representatives=True)
    rows = list[Row]()
    for hand in o.hands:
        tasks = [
            (spec, subject, hand, k % 2 == 0, o.simulator)
            for k, subject in enumerate(subjects(spec))
        ]
        found = run_all(compare, tasks, o.workers, CELL_SECONDS)
        rows += _rows(hand, [Found(**fields) for fields in found])
    return rows


@dataclasses.dataclass(frozen=True)
class Found:
    """What became of one object under two plans: a free one, and one kept to a region.

    The lists have two entries, of the free and of the kept plan. They are the number of executable
    grasps, the status of the best one's closing, and the seconds of the plan. `contacts` counts the
    contacts of all executable grasps of the kept plan, and `inside` those in the region.
    """

    family: str
    region: str
    executable: list[int]
    status: list[str]
    seconds: list[float]
    contacts: int
    inside: int

    def held(self, kept: bool) -> bool:
        """Tell whether the best grasp held: of the kept plan if `kept`, else of the free one."""
        return self.status[kept] == Status.OK.name


def compare(
    spec: TableSpec, subject: Subject, hand: str, upper: bool, simulator: str
) -> dict[str, Any]:
    """Plan free and in a region, close both best grasps, and return the fields of `Found`.

    If `upper`, the region is the cloud's upper half, else an end of it. A result that an earlier
    call wrote to a file is read.
    """
    path = spec.kept("region", f"{hand}_{subject.label}", upper, simulator).with_suffix(".json")
    return keep(path, lambda: dataclasses.asdict(_compare(spec, subject, hand, upper, simulator)))


def _compare(
    spec: TableSpec, subject: Subject, hand_name: str, upper: bool, simulator: str
) -> Found:
    """Plan free and in the region, and close both best grasps."""
    solid = read_solid(subject)
    hand = load_hand(hand_name)
    cloud = next(iter(solid.views.values()))
    mass = solid.mass or min(max(DENSITY * float(solid.mesh.volume), LIGHTEST), HEAVIEST)
    trial = dataclasses.replace(PROTOCOLS["household"].trial, simulator=simulator, mass=mass)
    contact_spec = ContactSpec(trial.friction, table=0.0)
    region = choose_half(cloud, upper)
    best = list[Grasps]()
    executable = list[int]()
    seconds = list[float]()
    contacts = torch.zeros(0, 3)
    for chosen in (None, region):
        asked = cloud, hand, contact_spec, spec.starts, spec.seed
        grasps, took = timed(partial(plan_grasps, *asked, keep=chosen))
        good = grasps.executable
        contacts = good.contacts.points.reshape(-1, 3)
        best.append(good[:1])
        executable.append(len(good))
        seconds.append(took)
    seed = seed_of(spec.seed, subject.label)
    surface = surface_field(fit_shape(cloud, table=0.0))
    given: dict[str, Any] = {"parts": solid.parts, "surface": surface}
    status = [
        close_hand(one, hand, solid.mesh, trial, seed, **given).status.name
        if len(one)
        else "NO_GRASP"
        for one in best
    ]
    inside = int((region(contacts) < 0).sum()) if len(contacts) else 0
    told = "upper half" if upper else "end"
    return Found(subject.family, told, executable, status, seconds, len(contacts), inside)


def choose_half(cloud: PointCloud, upper: bool) -> Region:
    """Return one half of a cloud's bounding box as a region for contacts.

    If `upper`, it is the upper half. Otherwise it is that half of the longer horizontal side which
    has fewer points.
    """
    if upper:
        return half_of(cloud, 2, far=True)
    points = cloud.points.double()
    low = points.amin(0)
    high = points.amax(0)
    axis = int((high - low)[:2].argmax())
    beyond = points[:, axis] > (low + high)[axis] / 2
    return half_of(cloud, axis, far=float(beyond.double().mean()) < 0.5)


def _rows(hand: str, found: Sequence[Found]) -> list[Row]:
    """Return the shares that held, their difference, and the contacts in the region."""
    free, kept = (count_by((x.family, x.held(k)) for x in found) for k in (False, True))
    shares = (share_over(free), share_over(kept))
    change = contrast_over([kept, free], [1.0, -1.0])
    each = {
        name: f"{sum(x.held(False) for x in mine)} and {sum(x.held(True) for x in mine)} of {len(mine)}"
        for name in ("upper half", "end")
        if (mine := [x for x in found if x.region == name])
    }
    text = f"free {format_share(shares[0])}, kept {format_share(shares[1])}: {format_points(change)}; free and kept by "
    text += "; ".join(f"{name}: {counts}" for name, counts in each.items())
    lost = {x.family: x.status for x in found if not (x.held(False) and x.held(True))}
    inside = sum(x.inside for x in found)
    contacts = sum(x.contacts for x in found)
    grasps, seconds = (
        [sum(getattr(x, name)[k] for x in found) for k in (0, 1)]
        for name in ("executable", "seconds")
    )
    more = f"{grasps[0]} executable grasps free, {grasps[1]} kept; {seconds[0]:.0f} and {seconds[1]:.0f} s of planning"
    near = change.value >= -0.03
    found_inside = f"{inside} of {contacts}; {more}"
    return [
        Row(f"held, {hand}", "within 3 points of free", text, near, {"lost": lost}),
        Row(f"contacts inside, {hand}", "100 %", found_inside, inside == contacts > 0),
    ]
