"""Numbers of a published URDF that no hand has: sizes, masses, ranges, efforts, velocities.

They are placeholders, or in another unit. Nothing is changed: the sentences are warnings.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from torchgrasp.hand.safe_xml import soft_limits
from torchgrasp.hand.urdf import Urdf

Bounds = tuple[float, float]  # the least and the greatest usual value


@dataclasses.dataclass(frozen=True)
class UsualNumbers:
    """Least and greatest values of robot hands, with room on both sides.

    Shipped and published hands of seven makers lie within them.
    """

    size: Bounds = (1e-3, 0.6)  # longest edge of a link [m]: a forearm is the largest
    place: Bounds = (0.0, 0.6)  # distance of a joint from the joint before it [m]
    # distance of the first joints of two fingers [m]: more are two hands
    apart: Bounds = (0.0, 0.3)
    turn: Bounds = (0.05, 3.6)  # range of a revolute joint [rad]: half a turn and some degrees
    slide: Bounds = (1e-3, 0.2)  # range of a sliding joint [m]
    # effort of a revolute joint [N m]: more is a placeholder, or in N mm
    torque: Bounds = (0.01, 9.0)
    force: Bounds = (0.1, 1000.0)  # effort of a sliding joint [N]
    turning: Bounds = (0.05, 200.0)  # velocity of a revolute joint [rad/s]
    sliding: Bounds = (1e-3, 10.0)  # velocity of a sliding joint [m/s]
    hand_mass: Bounds = (0.05, 4.5)  # mass of a hand [kg]: a Shadow hand with its forearm has 4.3
    # mass of a link over the volume of the box around its shapes [kg/m3]: at most that of metals;
    # the box may be a part of the link
    density: Bounds = (20.0, 25_000.0)
    edge: float = 5e-3  # least edge [m] of the box for this density, as flat shapes have no volume


USUAL = UsualNumbers()


def find_unusual(urdf: Urdf, points: Mapping[str, Sequence[np.ndarray]]) -> list[str]:
    """Return a warning for each kind of number in a URDF that is outside the range of real hands.

    The kinds are sizes, distances, masses, densities, and the joints' ranges, efforts and
    velocities; their ranges are those of `UsualNumbers`. `points` holds, by link, an array (n, 3)
    [m] of points on each of its shapes, in the link's frame. Numbers that the URDF lacks are not
    judged. One more warning names joints whose <safety_controller> has narrower limits, which the
    library ignores.
    """
    sizes = []
    dense = []
    for link in urdf.links:
        if not points[link.name]:
            continue
        size = np.ptp(np.concatenate(points[link.name]), axis=0)
        sizes.append((link.name, float(size.max())))
        volume = float(np.prod(np.maximum(size, USUAL.edge)))
        dense.append((f"{link.name} of {link.mass:.3g} kg", link.mass / volume))
    mass = sum(x.mass for x in urdf.links)
    places = [(j.name, math.hypot(*j.xyz)) for j in urdf.joints]
    first = [j for j in urdf.movable if not urdf.movers(j.parent)]
    # a joint's frame at zero is that of its child
    at_zero = {j.name: urdf.pose_at_zero(j.child)[:3, 3].tolist() for j in first}
    apart = [
        (f"{one} and {two}", math.dist(at_zero[one], at_zero[two]))
        for one, two in itertools.combinations(at_zero, 2)
    ]
    farthest = sorted(apart, key=lambda pair: pair[1])[-1:]
    named = [
        ("the size of links", "m", USUAL.size, sizes),
        ("the distance of joints from the joint before", "m", USUAL.place, places),
        ("the distance of two fingers, or of two hands (--root),", "m", USUAL.apart, farthest),
        ("the mass of the whole hand", "kg", USUAL.hand_mass, [(urdf.name, mass)]),
        ("the density of links", "kg/m3", USUAL.density, dense),
    ]
    for slides, kind, units, bounds in (
        (False, "joints", ("rad", "N m", "rad/s"), (USUAL.turn, USUAL.torque, USUAL.turning)),
        (True, "sliding joints", ("m", "N", "m/s"), (USUAL.slide, USUAL.force, USUAL.sliding)),
    ):
        joints = [j for j in urdf.movable if (j.kind == "prismatic") == slides]
        values = (
            [(j.name, j.upper - j.lower) for j in joints],
            [(j.name, j.effort) for j in joints],
            [(j.name, j.velocity) for j in joints],
        )
        for what, *rest in zip(("range", "effort", "velocity"), units, bounds, values, strict=True):
            named.append((f"the {what} of {kind}", *rest))
    found = [_outside(*kind) for kind in named]
    found.append(_soft_limits(urdf))
    return [sentence for sentence in found if sentence]


def _soft_limits(urdf: Urdf) -> str:
    """Return a sentence on the joints whose soft limits are narrower than their limits; "" if there
    is none.

    A robot's safety controller stops such a joint before a planned posture.
    """
    soft = soft_limits(urdf.data)
    narrow = []
    for j in urdf.movable:
        low, high = soft.get(j.name, (j.lower, j.upper))
        if low < high and (low > j.lower or high < j.upper):
            narrow.append(f"{j.name} {low:.3g} to {high:.3g} of {j.lower:.3g} to {j.upper:.3g}")
    if not narrow:
        return ""
    told = "soft limits (<safety_controller>) are not kept: narrow the <limit> if your robot keeps them"
    return f"{told}: {', '.join(narrow)}"


def _outside(what: str, unit: str, bounds: Bounds, values: Iterable[tuple[str, float]]) -> str:
    """Return a sentence that names the values outside their bounds; "" if there is none.

    A value that is zero or infinite is one that the URDF lacks.
    """
    least, most = bounds
    known = [(name, x) for name, x in values if 0 < x < np.inf]
    odd = [f"{name} {x:.3g}" for name, x in known if not least <= x <= most]
    if not odd:
        return ""
    usual = f"{least:g} to {most:g} {unit}"
    return f"{what} is that of no hand ({usual}), look over the URDF: {', '.join(odd)}"
