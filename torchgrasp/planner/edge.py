"""Grasps of a low object at the edge of its table. The hand drags it there, then grasps what hangs
over.

A fingertip cannot reach below an object that lies flat. So the hand presses on it from above, and
drags it until a part hangs over the edge. Its centre of mass stays above the table. The fingers
then pinch this part from above and below.
"""

import dataclasses
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.data.accept import HandLike, SeenLike, as_hand, as_seen
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Count, Range, Seed
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.geometry.frames import apply, inverse, rigid
from torchgrasp.geometry.linalg import Points
from torchgrasp.geometry.plane import Plane, move
from torchgrasp.ik.clearance import Obstacles
from torchgrasp.planner.drag_plan import DRAG, DragPlan, EdgeBalance, find_drag
from torchgrasp.planner.drag_text import with_drag
from torchgrasp.planner.objects import ShapedObject
from torchgrasp.planner.request import Request
from torchgrasp.planner.run import plan_shaped
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.success.task import GraspTask, TaskWrenches
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.planning import Grasps
from torchgrasp.values.specs import GRAVITY, ContactSpec


@checked
@dataclasses.dataclass(frozen=True)
class EdgePlan(Value):
    """A drag of the object along its table to the edge, and the grasps there; `plan_edge_grasps`
    returns it.

    Attributes:
        drag: the drag; None if there is none, for which `reason` tells why.
        grasps: grasps of the object after the drag; without a drag, of the object where it stands.
            They are in the frame of the cloud, the best first, as those of `plan_grasps`. Their
            metadata hold the drag (`torchgrasp.planner.drag_of`), so that one file has both.
        shape: the estimated shape after the drag, in the same frame; without a drag, where the
            object stands.
        reason: why there is no drag, as a sentence; "" if there is one. Reasons are: the object
            already hangs over the edge far enough; it is too heavy; no posture of the hand can
            press on it; a neighbour is in its way; in a scene, the drag would be longer than 0.25 m
            (`OCCUPANCY.sideways`).
    """

    drag: DragPlan | None
    grasps: Grasps
    shape: ShapeGP
    reason: str = ""

    @property
    def success(self) -> float:
        """The predicted success, in [0, 1], of the drag and the first grasp together.

        It is that of the grasp, times 0.85 if there is a drag (`DRAG.ended`). This factor is the
        share of simulated drags that ended as planned. The result is 0 without an executable grasp,
        one that passed all checks. It is NaN if the grasp's success is unknown.
        """
        good = self.grasps.executable
        if not len(good):
            return 0.0
        sure = 1.0 if self.drag is None else DRAG.ended
        return sure * float(good.success[0])


@checked
@single_threaded
def plan_edge_grasps(
    cloud: SeenLike,
    hand: HandLike,
    spec: ContactSpec,
    starts: Count = 1000,
    seed: Seed = 0,
    *,
    task: GraspTask | None = None,
    table_friction: Annotated[float, Range(0.0, 10.0)] = 0.3,
) -> EdgePlan:
    """Plan to drag the object to the edge of its table, and grasps there; return both.

    A drag presses on the object from above and moves it along the table. The grasps resist 1.5
    times the object's weight (`DRAG.carried`), as with the argument `resist` of `plan_grasps`.

    Args:
        cloud: points that a camera saw [m], as for `plan_grasps`.
        hand: the hand, or its name or folder.
        spec: constraints. Its `table` must be a plane with an `edge` (`Plane.ending`). Its `region`
            is given for the object before the drag, and moves with the object. If its `friction` is
            a distribution, the drag is planned with the 10 % quantile (`DRAG.sure`).
        starts: number of random initial guesses of the contact planner.
        seed: random seed.
        task: what grasps must do; None means `GraspTask()`. If its mass is a distribution, the drag
            is planned for the greatest mass.
        table_friction: coefficient of friction between object and table. The pressing force is
            three times (`DRAG.reserve`) the least one that moves the object (Coulomb's law). It is
            at least twice the weight and 1 N, but at most 20 N.

    Raises:
        BadArgument: a table without an edge; or an edge more than 15 mm (`DRAG.behind`) behind the
            object's estimated centre of mass. There the object would fall. Also an edge more than 2
            m (`DRAG.farthest`) from all points, whose numbers are then not metres.
        BadArgument: a friction of the fingertips that is not greater than `table_friction`.

    >>> import torch
    >>> from torchgrasp import Plane, load_hand, load_object
    >>> x = torch.tensor([1.0, 0, 0])
    >>> spec = ContactSpec(table=Plane.horizontal(0.0).ending(0.2 * x, x))
    >>> plan = plan_edge_grasps(load_object("cylinder"), load_hand("barrett"), spec, starts=8)
    """
    table = _table_with_edge(spec)
    friction = _sure_friction(spec, table_friction)
    hand = as_hand(hand, "hand")
    seen = as_seen(cloud, "cloud")
    check_edge(table, seen.points, "spec.table")
    request = Request(seen, hand, spec, starts, seed, task=task)
    object_ = ShapedObject.of(request)
    frame = object_.obj_from_upright
    balance = EdgeBalance.of(object_, table)
    if balance.away < -DRAG.behind:
        found = f"an edge {-1e3 * balance.away:.0f} mm behind the object's centre"
        raise BadArgument("spec.table", found, "an edge beyond it")
    mass = Distribution.of(request.grasp_task.mass).most
    load = _weight(mass, table, apply(frame, balance.centre[None])[0])
    request = dataclasses.replace(request, resist=load)
    drag = find_drag(object_, hand, table, mass, friction, table_friction)
    if isinstance(drag, str):
        return EdgePlan(None, plan_shaped(object_, request), object_.shape.moved(frame), drag)
    # in the object's own frame, the drag brings the edge and the neighbours the other way
    shift = rigid(torch.eye(3, dtype=torch.float64), drag.displacement)
    assert table.edge is not None
    nearer = dataclasses.replace(table, edge=table.edge.moved(inverse(shift)))
    obstacles = _brought(object_, drag.displacement)
    dragged = dataclasses.replace(object_, table=nearer, obstacles=obstacles)
    # back in the frame of the cloud, the table is where it was
    grasps = move(plan_shaped(dragged, request), shift)
    grasps = dataclasses.replace(grasps, meta={**grasps.meta, "table": table.describe()})
    return EdgePlan(drag, with_drag(grasps, drag), object_.shape.moved(shift @ frame))


def _table_with_edge(spec: ContactSpec) -> Plane:
    """Return the table, in float64 on the CPU; raise `BadArgument` unless it has an edge."""
    table = spec.plane
    if table is None or table.edge is None:
        found = "no table" if table is None else "a table without an edge"
        raise BadArgument("spec.table", found, "a plane with an edge (`Plane.ending`)")
    return table.to("cpu", torch.float64)


def check_edge(table: Plane, points: Points, name: str) -> None:
    """Raise `BadArgument` if a table's edge is more than 2 m (`DRAG.farthest`) beyond all points of
    a view: it is then not in metres.

    `points` (n, 3) [m] and `table` are in one frame. `name` is the argument's name in the error.
    """
    assert table.edge is not None
    away = -float(table.edge.to("cpu", torch.float64).height(points.cpu().double()).max())
    if away > DRAG.farthest:
        found = f"an edge {away:.4g} m from all points"
        raise BadArgument(name, found, f"one within {DRAG.farthest:g} m, in metres")


def _sure_friction(spec: ContactSpec, table_friction: float) -> float:
    """Return the friction of the fingertips that the drag counts on; raise `BadArgument` unless it
    is greater than the table's.
    """
    sure = torch.tensor(DRAG.sure, dtype=torch.float64)
    friction = float(Distribution.of(spec.friction).quantile(sure))
    if not friction > table_friction:
        found = f"{table_friction:g}, and {friction:g} of the fingertips"
        raise BadArgument("table_friction", found, "less than the friction of the fingertips")
    return friction


def _weight(mass: float, table: Plane, centre: Float[Tensor, "3"]) -> TaskWrenches:
    """Return the load that grasps must resist: the weight of a `mass` [kg], with a reserve, at the
    `centre` [m].

    The hand grasps the object beside its centre of mass, so that its weight would turn it.
    """
    force = -DRAG.carried * mass * GRAVITY * table.normal.double()
    return TaskWrenches(torch.cat([force, torch.zeros_like(force)])[None], centre)


def _brought(object_: ShapedObject, displacement: Float[Tensor, "3"]) -> Obstacles | None:
    """Return the obstacles as the object finds them after a `displacement` [m]: they have come the
    other way.
    """
    if object_.obstacles is None:
        return None
    field = object_.obstacles.field
    way = inverse(object_.obj_from_upright)[:3, :3] @ displacement
    field = dataclasses.replace(field, origin=field.origin - way.to(field.origin))
    return dataclasses.replace(object_.obstacles, field=field)
