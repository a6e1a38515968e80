"""Where the contacts of grasps lie that were planned on one real view. They lie on measured
surface, or on guessed surface that says so.
"""

import dataclasses
import statistics

import torch
from scipy.spatial import KDTree
from torch import Tensor

from benchmarks.common import Options, Row
from torchgrasp import ContactSpec, load_hand, plan_grasps
from torchgrasp.foundation.errors import GraspError
from torchgrasp.shape.fit import fit_shape
from torchgrasp.values.planning import PointCloud

NEAR = 0.005
"""Distance [m] from a measured point within which a contact is on measured surface."""

TOLD = 0.5
"""Share of a contact's distance from measured points that its std_m must have to tell it."""

LEAST = 0.85
"""Least share of contacts on measured surface."""

FRICTION = 0.8
"""Friction of the plans."""


@dataclasses.dataclass(frozen=True)
class Touch:
    """The f contacts of one grasp on a real view, and its predicted success in [0, 1].

    `away` (f,) [m] are their distances from the nearest point that any camera measured. `std_m`
    (f,) [m] are the standard deviations of the estimated surface there.
    """

    away: Tensor
    std_m: Tensor
    success: float


def contact_row(name: str, clouds: dict[str, dict[str, Tensor]], table: float, o: Options) -> Row:
    """Return the row that judges the contacts of the best grasps of a hand, planned on each view
    alone.

    `clouds` holds the points (n, 3) [m] of each thing by camera. `table` is the height [m] of their
    table.
    """
    hand = load_hand(name)
    found = list[Touch]()
    refused = 0
    for thing, views in clouds.items():
        measured = torch.cat(list(views.values()))
        for camera, points in views.items():
            cloud = PointCloud(points)
            try:
                shape = fit_shape(cloud, table=table)
                spec = ContactSpec(friction=FRICTION, table=table)
                plan = plan_grasps(cloud, hand, spec, o.starts, o.seed)
            except GraspError:
                refused += 1
                continue
            good = plan.executable
            if not len(good):
                refused += 1
                continue
            contacts = good.contacts.points[0].double()
            away = distance_from(measured, contacts)
            std_m = shape.predict(contacts).std_m
            found.append(Touch(away, std_m, float(torch.sigmoid(good.score[0]))))
            print(f"{thing}_{camera}, {name}: {tell(found[-1])}", flush=True)
    if not found:
        return Row(f"contacts on real views, {name}", "-", f"{refused} views without a grasp")
    what = f"contacts of the best grasp, {len(found)} real views, {name}"
    return judge_contacts(what, found, refused)


def distance_from(measured: Tensor, points: Tensor) -> Tensor:
    """Return the distance (n,) [m] of each of `points` (n, 3) from the nearest measured point."""
    return torch.from_numpy(KDTree(measured.numpy()).query(points.numpy())[0])


def tell(touch: Touch) -> str:
    """Return the distance and the deviation `std_m` [mm] of each contact of a grasp, as text."""
    pairs = zip(touch.away.tolist(), touch.std_m.tolist(), strict=True)
    text = ", ".join(f"{1e3 * d:.1f} mm (std_m {1e3 * s:.1f})" for d, s in pairs)
    return f"{text} from a measured point"


def judge_contacts(what: str, found: list[Touch], refused: int) -> Row:
    """Return the row that judges contacts of grasps: near a measured point, or uncertain.

    A contact is near within 5 mm (`NEAR`). A farther one must have a `std_m` of half its distance
    or more. `refused` counts the views without a grasp.
    """
    distance = torch.cat([touch.away for touch in found])
    deviation = torch.cat([touch.std_m for touch in found])
    near = distance <= NEAR
    told = (deviation >= TOLD * distance) & ~near
    share = float(near.double().mean())
    rest = int((~near).sum())
    success = statistics.mean(touch.success for touch in found)
    words = f"{share:.0%} of {len(near)}; {int(told.sum())} of the other {rest} are told"
    words += f"; predicted success {success:.3f}; {refused} views without a grasp"
    met = share >= LEAST and int(told.sum()) == rest
    bar = ">= 85 % within 5 mm of a measured point, all others with std_m of half their distance"
    return Row(what, bar, words, met, {"away": distance, "std_m": deviation})
