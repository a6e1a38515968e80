"""The key moments of a simulated closing, and when and why the object was lost."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.app.report.canvas import ALARM, INK
from torchgrasp.evaluation.causes import moved_in_hand, tick_of
from torchgrasp.evaluation.criterion import SLIP_ANGLE, SLIP_DISTANCE
from torchgrasp.evaluation.lift import LIFT_TIME, PUSHED_DISTANCE
from torchgrasp.foundation.base import flatnonzero
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.geometry.frames import apply, real
from torchgrasp.geometry.linalg import norm
from torchgrasp.values.closing import ClosureResult

LOST = "lost"  # name of the moment at which an object was lost
CREEP = 0.01  # fingertips that stick slide more slowly than this [m/s]


def mass_centre(mesh: "trimesh.Trimesh") -> Float[Tensor, "3"]:
    """Return the centre of mass (3,) [m] of a closed mesh of uniform density, in its frame."""
    return real(np.array(mesh.center_mass))


class Moment(NamedTuple):
    """A key moment of a simulated closing.

    `tick` is its index among the recorded control ticks, the periods of the controller. `name` is
    its title in the film strip, such as "pressed".
    """

    tick: int
    name: str

    @property
    def color(self) -> str:
        """The colour "#rrggbb" of the moment's title and line in the film strip: red for the loss
        of the object.
        """
        return ALARM if self.name == LOST else INK


def touching(closure: ClosureResult) -> Bool[Tensor, "t f"]:
    """Return a mask (t, f): which of f fingertips touch the object at each of t control ticks.

    A control tick is a period of the controller.
    """
    return closure.trace.normals.isfinite().all(-1)


def first_touches(closure: ClosureResult) -> list[int]:
    """Return the index of the control tick at which each finger first touched the object.

    A control tick is a period of the controller. The order is that of `closure.contact_order`, from
    the first touch to the last. Fingers that never touched are left out.
    """
    touched = touching(closure)
    return [int(touched[:, finger].int().argmax()) for finger in closure.contact_order]


def moved_from_place(closure: ClosureResult, centre: Float[Tensor, "3"]) -> Float[Tensor, " t"]:
    """Return the distance (t,) [m] of the object's centre of mass from its first place, at each
    control tick. `centre` (3,) [m] is the centre in the frame of the grasp.
    """
    middle = centre.double().expand(len(closure.time), 1, 3)
    places = apply(closure.object_pose.double(), middle)[:, 0]  # (t, 3)
    return norm(places - places[0])


def find_loss(closure: ClosureResult, centre: Float[Tensor, "3"]) -> int | None:
    """Return the index of the control tick at which the object was lost; None if it was held.

    A control tick is a period of the controller. The object was lost when it was pushed away by 50
    mm. It was also lost when it slipped by 20 mm or turned by 30 degrees in the hand. A third case
    is that fewer than two fingers still touched it. An object that was put down as too heavy was
    lost at the hand's greatest height. A trial that began with an overlap, or diverged, lost it at
    its last tick. `centre` is the object's centre of mass [m] in the frame of the grasp, where z is
    up.
    """
    if closure.held:
        return None
    last = len(closure.time) - 1
    pressed = tick_of(closure, 2)
    if closure.status in (Status.START_OVERLAP, Status.UNSTABLE):
        return last
    if closure.status is Status.TOO_HEAVY:
        return int(closure.hand_pose[:, 2, 3].argmax())
    if closure.status is Status.EJECTED:
        away = moved_from_place(closure, centre) > PUSHED_DISTANCE
        return int(away.int().argmax()) if away.any() else last
    # else it slipped too far, or at most one finger still touched it: the earlier of both
    distance, angle = moved_in_hand(closure, centre)
    gone = (distance > SLIP_DISTANCE) | (angle > SLIP_ANGLE)
    gone[: pressed + 1] = False
    held = torch.nonzero(touching(closure).sum(1) >= 2)
    let_go = min(int(held[-1]) + 1, last) if len(held) else pressed
    return min(let_go, int(gone.int().argmax()) if gone.any() else last)


def explain_loss(
    closure: ClosureResult, centre: Float[Tensor, "3"], fingers: tuple[str, ...]
) -> str:
    """Return a sentence on when and in which phase the object was lost, and on the cause.

    The cause is the finger that never touched, or first slid or let go; else the status of the
    closing. `centre` is the object's centre of mass [m] in the frame of the grasp, where z is up.
    `fingers` are the names of the fingers, in the order of the record. The text is "" if the object
    was held.
    """
    tick = find_loss(closure, centre)
    if tick is None:
        return ""
    pressed = tick_of(closure, 2)
    rises = bool(closure.phases[2].isfinite())
    time = float(closure.time[tick])
    start = float(closure.time[pressed])
    if not rises or tick <= pressed:
        phase = "closed"
    else:
        phase = "rose" if time < start + LIFT_TIME else "held it"
    absent = [name for k, name in enumerate(fingers) if k not in closure.contact_order]
    if absent:
        reason = f"{' and '.join(absent)} never touched the object"
    else:
        reason = _first_to_go(closure, tick, fingers)
    # these ends are no fault of a finger
    if closure.status in (Status.START_OVERLAP, Status.UNSTABLE, Status.TOO_HEAVY) or not reason:
        reason = closure.status.sentence
    lost = "Put down from" if closure.status is Status.TOO_HEAVY else "Lost at"
    return f"{lost} {time:.2f} s, while the hand {phase}: {reason}."


def _first_to_go(closure: ClosureResult, tick: int, fingers: tuple[str, ...]) -> str:
    """Return a text that names the finger that first slid or let go for good before a tick. It is
    "" if none did.
    """
    touched = touching(closure)[: tick + 1]
    sliding = closure.trace.sliding[: tick + 1].nan_to_num(0.0)
    firm = touched & (sliding < CREEP)
    # The first tick after which each finger was never firm again; the finger with the earliest gave
    # way first.
    ticks = [torch.nonzero(column) for column in firm.T]
    since = [int(found[-1]) + 1 if len(found) else 0 for found in ticks]
    finger = min(range(len(since)), key=since.__getitem__)
    begin = since[finger]
    if begin > tick:
        return ""
    name = fingers[finger]
    time = float(closure.time[begin])
    if not touched[begin, finger]:
        return f"{name} let go first, at {time:.2f} s"
    force = closure.trace.forces[begin, finger]
    normal = closure.trace.normals[begin, finger]
    press = float((force @ normal).abs())
    across = float(norm(force - (force @ normal) * normal))
    loads = f"under {across:.1f} N across at {press:.1f} N of normal force"
    return f"{name} slid first, from {time:.2f} s on, {loads}"


def moments_of(
    closure: ClosureResult, centre: Float[Tensor, "3"], fingers: tuple[str, ...]
) -> list[Moment]:
    """Return the key moments that the film strip of a closing shows, in the order of time.

    They are the open hand, the first touch, the ends of closing and pressing, and the loss of the
    object. The last is the end of the record. If the hand closed several times, the begin of the
    last closing is another. Moments that did not happen are left out. Of two at the same control
    tick, one is kept. `centre` is the object's centre of mass [m] in the frame of the grasp, where
    z is up. `fingers` are the names of the fingers, in the order of the record.
    """
    found = [Moment(tick_of(closure, 0), "open hand")]
    if closure.contact_order:
        first = fingers[closure.contact_order[0]]
        found.append(Moment(first_touches(closure)[0], f"{first} touches first"))
    # each closing begins where the control of the forces begins to act
    acts = torch.cat([torch.zeros(1, dtype=torch.bool), closure.trace.blend.isfinite().any(1)])
    begins = flatnonzero(acts[1:] & ~acts[:-1])
    if closure.attempts == len(begins) > 1:
        found.append(Moment(int(begins[-1]), f"closing {len(begins)} begins"))
    all_touch = len(closure.contact_order) == len(fingers)
    ends = ((1, "all touch" if all_touch else "the closing ends"), (2, "pressed"))
    for k, name in ends:
        if closure.phases[k].isfinite():
            found.append(Moment(tick_of(closure, k), name))
    lost = find_loss(closure, centre)
    if lost is not None:
        found.append(Moment(lost, LOST))
    found.append(Moment(len(closure.time) - 1, "the end"))
    # of two at one tick, the later is kept
    found.sort(key=lambda moment: (moment.tick, moment.name == LOST))
    later = [*(moment.tick for moment in found[1:]), len(closure.time)]
    return [m for m, tick in zip(found, later, strict=True) if m.tick < tick]
