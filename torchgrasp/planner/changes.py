"""Single changes of a planning request that could give grasps: to the hand, the constraints, or the
world.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any

import torch

from torchgrasp.foundation.errors import Status
from torchgrasp.hand.load import list_hands, load_hand
from torchgrasp.planner.objects import take_target
from torchgrasp.planner.request import Request, finger_sets
from torchgrasp.scene.scene import Scene


@dataclasses.dataclass(frozen=True)
class ChangeNumbers:
    """The values to which a limit or a property of a request is changed, and bounds of these
    changes.
    """

    frictions: tuple[float, ...] = (0.4, 0.8, 1.2)
    """Coefficients of friction that are tried: of smooth plastic, of rubber, of soft silicone."""
    clearly: float = 1.4
    """Least ratio of a tried friction to the present one."""
    tried: int = 2
    """Greatest number of frictions that are tried."""
    variances: tuple[float, ...] = (0.03, 0.1)
    """Greatest variances of the surface's distance at a contact that are tried. They are in squared
    normalised units; such a unit is half the object's size.
    """
    flatnesses: tuple[float, ...] = (0.44, 0.9)
    """Greatest angles [rad] between the normals at a contact and on a ring around it that are
    tried.
    """
    margins: tuple[float, ...] = (0.5, 1.0)
    """Values of `friction_margin` that are tried: shares of the friction with which contacts are
    planned.
    """
    compared: int = 1000
    """Greatest number of points of an object whose distances to the target are computed."""
    beside: float = 0.15
    """Distance [m] from the target within which an object is its neighbour: a finger's reach."""


CHANGES = ChangeNumbers()
UNKNOWN = frozenset({Status.OUT_OF_DOMAIN, Status.TOO_UNCERTAIN})
AT_TABLE = frozenset(
    {Status.BELOW_TABLE, Status.TABLE_COLLISION, Status.PREGRASP, Status.NO_APPROACH}
)
OPEN = frozenset({Status.NOT_CLOSED, Status.DEGENERATE})
OF_HAND = frozenset(
    status for status in Status if Status.OUT_OF_REACH <= status <= Status.NO_APPROACH
)


@dataclasses.dataclass(frozen=True)
class Change:
    """A planning request with one change.

    Args:
        words: description of the change.
        choice: whether the user can make the change; otherwise it is a change of the world, such as
            a higher friction.
        cures: the statuses of failed grasps or contact sets that the change could prevent.
        request: the request with the change.
        refit: whether the object's shape must be estimated anew.
        more: whether the change is more initial guesses.
    """

    words: str
    choice: bool
    cures: frozenset[Status]
    request: Request
    refit: bool = False
    more: bool = False


def _with(request: Request, **fields: Any) -> Request:
    """Return the request with given fields of its contact constraints (`ContactSpec`) replaced."""
    return dataclasses.replace(request, spec=dataclasses.replace(request.contact_spec, **fields))


def list_changes(request: Request) -> list[Change]:
    """Return all changes of a request, each of one setting, that could give grasps.

    They concern regions and loads, the surroundings, the fingers, limits of contacts, the friction,
    and other hands. A change to more initial guesses (`more_starts`) is not among them.
    """
    kinds = (_regions, _surroundings, _fingers, _limits, _friction, _hands)
    return [change for kind in kinds for change in kind(request)]


def more_starts(request: Request, ratio: int) -> Change:
    """Return a change of the request: to `ratio` times as many initial guesses as it has."""
    more = dataclasses.replace(request, starts=ratio * request.starts)
    return Change(f"with {more.starts} starts", True, frozenset(Status), more, more=True)


def _regions(request: Request) -> Iterator[Change]:
    """Yield changes that each give up a demand on contacts. It is the region to keep to, the region
    to avoid, or the task's loads.
    """
    for name in ("keep", "avoid", "resist"):
        if getattr(request, name) is not None:
            cures = OPEN | OF_HAND | {Status.NOT_RESISTED if name == "resist" else Status.OUTSIDE}
            yield Change(
                f"without {name}", True, cures, dataclasses.replace(request, **{name: None})
            )


def _fingers(request: Request) -> Iterator[Change]:
    """Yield a change to each other set of fingers of the hand. In a mode other than "joint", yield
    a change to "joint".
    """
    mode = request.mode
    fingers = request.fingers
    if mode != "joint":
        yield Change(
            "with mode='joint'",
            True,
            OF_HAND | OPEN,
            dataclasses.replace(request, mode="joint"),
            refit=True,
        )
    elif fingers != "auto":
        present = finger_sets(request.hand, fingers)[0]
        for hand in finger_sets(request.hand, "auto"):
            if hand.finger_names != present.finger_names:
                words = f"with fingers={hand.source.option!r} ({', '.join(hand.finger_names)})"
                other = dataclasses.replace(request, hand=hand, fingers=None)
                yield Change(words, True, OF_HAND | OPEN, other)


def _hands(request: Request) -> Iterator[Change]:
    """Yield a change to each other shipped hand, except variants such as the left; in mode "joint",
    without an arm.
    """
    if request.mode != "joint" or request.arm is not None:
        return
    names = list_hands()
    for name in names:
        own = f"{request.hand.name}_".startswith(f"{name}_")
        variant = any(name.startswith(f"{k}_") for k in names)
        if not own and not variant:
            other = dataclasses.replace(request, hand=load_hand(name), fingers=None)
            yield Change(f"with the {name} hand", True, OF_HAND, other)


def _limits(request: Request) -> Iterator[Change]:
    """Yield changes that each relax one limit on contacts: to the default limit, or beyond it."""
    spec = request.contact_spec
    tips = float(request.hand.tips.radius.max())
    own = spec.for_fingertips(tips)
    if (wider := _next(CHANGES.variances, spec.max_variance)) is not None:
        words = f"with max_variance={wider:g} instead of {spec.max_variance:g} (contacts on a less certain surface)"
        yield Change(words, True, UNKNOWN, _with(request, max_variance=wider))
    if (
        spec.flatness is not None
        and (wider := _next(CHANGES.flatnesses, spec.flatness)) is not None
    ):
        words = f"with flatness={wider:g} instead of {spec.flatness:g} (contacts nearer to edges)"
        yield Change(words, True, frozenset({Status.NOT_FLAT}), _with(request, flatness=wider))
    if (least := own.least_separation) > 0:
        usual = dataclasses.replace(own, separation=None).least_separation
        nearer = usual if usual < least else least / 2
        words = f"with separation={nearer:.3g} instead of {least:.3g} m (fingertips nearer to each other)"
        yield Change(words, True, frozenset({Status.TOO_CLOSE}), _with(request, separation=nearer))
    if 0 < tips < own.fingertip_radius:
        words = (
            f"with tip_radius={tips:.3g}, the hand's own, instead of {own.fingertip_radius:.3g} m"
        )
        cures = frozenset({Status.BELOW_TABLE, Status.TOO_CLOSE})
        yield Change(words, True, cures, _with(request, tip_radius=tips))
    if (
        spec.mean_friction > 0
        and (wider := _next(CHANGES.margins, spec.friction_margin)) is not None
    ):
        words = f"with friction_margin={wider:g} instead of {spec.friction_margin:g} (less room for errors)"
        yield Change(words, True, OPEN, _with(request, friction_margin=wider))


def _next(limits: tuple[float, ...], present: float) -> float | None:
    """Return the first of `limits` above the present limit, or None if none is above."""
    return next((limit for limit in limits if limit > present), None)


def _friction(request: Request) -> Iterator[Change]:
    """Yield changes to the next two frictions that are clearly above the present one."""
    present = request.contact_spec.mean_friction
    higher = [f for f in CHANGES.frictions if f >= CHANGES.clearly * present]
    for friction in higher[: CHANGES.tried]:
        words = f"if the friction were {friction:g} instead of {present:g}"
        yield Change(words, False, OPEN, _with(request, friction=friction))


def near_target(scene: Scene) -> list[int]:
    """Return the labels of the objects within 0.15 m (`CHANGES.beside`) of the scene's target, the
    nearest first.
    """
    some = dict[int, torch.Tensor]()
    for label in scene.things:
        part = scene.points[scene.labels == label]
        some[label] = part[:: 1 + len(part) // CHANGES.compared]
    own = some.pop(scene.target or 0)
    gaps = {label: float(torch.cdist(own, other).min()) for label, other in some.items()}
    near = [label for label, gap in gaps.items() if gap < CHANGES.beside]
    return sorted(near, key=lambda label: gaps[label])


def _surrounding(scene: Scene) -> str:
    """Return what stands around a target: objects near it, or else what is no object."""
    near = sorted(near_target(scene))
    if not near:
        return "what is no object (a wall, or furniture beside it)"
    return (
        f"its neighbours ({'object' if len(near) == 1 else 'objects'} {', '.join(map(str, near))})"
    )


def _surroundings(request: Request) -> Iterator[Change]:
    """Yield changes of the surroundings: another table, no neighbours, an arm that reaches every
    pose.
    """
    cloud = request.cloud
    spec = request.contact_spec
    if isinstance(cloud, Scene):
        crowded = OF_HAND | {Status.NEIGHBOUR_COLLISION, Status.BURIED}
        if not spec.contact_allowed:
            words = "with contact_allowed=True (links may push the neighbours)"
            yield Change(
                words, True, crowded - {Status.BURIED}, _with(request, contact_allowed=True)
            )
        table = cloud.table if spec.table is None else spec.table
        alone = dataclasses.replace(
            _with(request, table=table), cloud=take_target(cloud, request.seed)
        )
        words = f"if {_surrounding(cloud)} were taken away first"
        yield Change(words, False, crowded, alone, refit=True)
    elif spec.table is not None:
        words = "if no table were in the way, as on a narrow stand"
        yield Change(
            words, False, AT_TABLE | {Status.TIP_ERROR}, _with(request, table=None), refit=True
        )
    else:
        lowest = float(cloud.points[:, 2].min())
        words = f"if it stood on a table at z = {lowest:.3f} m, its lowest point"
        yield Change(words, False, UNKNOWN, _with(request, table=lowest), refit=True)
    if request.reachable is not None or request.arm is not None:
        cures = frozenset({Status.UNREACHABLE, Status.OUT_OF_REACH})
        yield Change(
            "if the arm reached every pose",
            False,
            cures,
            dataclasses.replace(request, reachable=None, arm=None),
        )
