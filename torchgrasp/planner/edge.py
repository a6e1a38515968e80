"""Grasps of a low object at the edge of its table: the hand drags it there, then grasps what hangs
over.

A fingertip cannot reach below an object that lies flat. So the hand presses on it from above, and
drags it until a part hangs over the edge, while its centre of mass stays above the table. The
fingers then pinch this part from above and below.
"""

import dataclasses
import math
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.data.accept import HandLike, SeenLike, as_hand, as_seen
from torchgrasp.foundation.base import Value, flatnonzero
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import ANY, Count, Pose, Range, Seed
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.geometry.frames import apply, inverse, rigid
from torchgrasp.geometry.linalg import norm, unit
from torchgrasp.geometry.plane import Plane, move
from torchgrasp.geometry.signed_distance import DistanceField
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.clearance import Obstacles
from torchgrasp.ik.press import PressPostures, press_postures
from torchgrasp.planner.objects import ShapedObject
from torchgrasp.planner.request import Request
from torchgrasp.planner.run import plan_shaped
from torchgrasp.scene.occupancy import OCCUPANCY
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.success.task import GraspTask
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.planning import Grasps
from torchgrasp.values.specs import ContactSpec

GRAVITY = 9.81  # acceleration [m/s^2]


@dataclasses.dataclass(frozen=True)
class DragNumbers:
    """Parameters of a drag to the edge."""

    behind: float = 0.012
    """Distance [m] behind the edge at which the centre of mass ends: its estimate is 5 mm off."""
    supported: float = 0.004
    """Least distance [m] behind the edge of each pressing tip at the end of the drag."""
    spacing: float = 0.008
    """Distance [m] of the places on the object's top where the hand may press."""
    places: int = 60
    """Number of these places that are tried, those nearest to the centre of mass."""
    postures: int = 40
    """Number of postures of two tips, and of one, that are tried at each place."""
    turns: int = 24
    """Number of directions about the vertical in which each posture is tried."""
    upward: float = 0.9
    """Least upward part of the unit normal where a tip presses: 25 degrees."""
    rim: float = 0.002
    """Distance [m] of a pressing tip from the object's outline."""
    ring: int = 8
    """Number of points on the circle of radius `rim` that must lie on the object's top."""
    flat: float = 0.003
    """Largest difference [m] of heights on this circle."""
    near: float = 0.0025
    """Largest horizontal distance [m] of a point on the top from the middle of a triangle."""
    finest: int = 8
    """Greatest number of parts into which edges of a coarse mesh are cut, so that middles are near."""
    clear: float = 0.003
    """Least clearance [m] of all other links from the object and the table."""
    lowered: int = 6
    """Number of heights at which the hand is checked on its way down."""
    approach: float = 0.05
    """Height [m] from which the hand comes down."""
    steps: int = 8
    """Number of places on the way along the table at which hand and object are checked."""
    unloading: float = 0.2
    """Greatest loss of pressing force for each newton of the drag: then the tips would slip."""
    digging: float = 0.8
    """Greatest gain of pressing force for each newton of the drag: then the tips would jam."""
    reserve: float = 3.0
    """Ratio of the pressing force to the least one that moves the object."""
    least: float = 1.0
    """Least pressing force [N]: sensors are off by 0.1 N."""
    most: float = 20.0
    """Greatest pressing force [N]: thin things bend, and hands are weak."""
    enough: float = 1.5
    """Least ratio of the pressing force to the least one, for an object that needs more than `most`.
    """
    sure: float = 0.1
    """Probability that friction is less than the one that the drag counts on."""
    sunk: float = 0.005
    """Greatest depth [m] of a pressing tip in the estimated shape: estimates are a few mm off."""
    shortest: float = 0.002
    """Length [m] of a drag that is not worth while: sensors are off by as much."""


DRAG = DragNumbers()


@checked
@dataclasses.dataclass(frozen=True)
class DragPlan(Value):
    """How a hand drags an object along its table: it presses from above, and moves sideways.

    Everything is in the frame of the cloud. f counts fingertips, and h actuated joints.

    Attributes:
        joints: actuated joints (h,) [rad or m] of the pressing hand; they stay the same.
        obj_from_hand: pose (4, 4) [m] of the hand's root link where the tips touch the object.
        presses: mask (f,) of the fingers that press.
        feet: points (f, 3) [m] where the tips touch; NaN for fingers that do not press.
        displacement: displacement (3,) [m] of hand and object along the table.
        force: sum of the normal forces [N] of the pressing fingers.
        table: the table.

    Tensors of a plan are in float64 on the CPU.
    """

    joints: Float[Tensor, "h"]
    obj_from_hand: Pose
    presses: Bool[Tensor, "f"]
    feet: Annotated[Float[Tensor, "f 3"], ANY]
    displacement: Float[Tensor, "3"]
    force: float
    table: Plane


@checked
@dataclasses.dataclass(frozen=True)
class EdgePlan(Value):
    """A drag to the table's edge, and the grasps there; `plan_edge_grasps` returns it.

    Attributes:
        drag: the drag; None if there is none, for which `reason` tells why.
        grasps: grasps of the object after the drag, or of the object where it stands without one.
            They are in the frame of the cloud, the best first, as those of `plan_grasps`.
        shape: the estimated shape after the drag, in the same frame.
        reason: why there is no drag: the object hangs over the edge far enough, or is too heavy, or
            no posture of the hand can press on it, or a neighbour is in its way. Or the edge is too
            far for what the camera saw of a scene. Empty if there is a drag.
    """

    drag: DragPlan | None
    grasps: Grasps
    shape: ShapeGP
    reason: str = ""


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

    Args:
        cloud: points that a camera saw [m], as for `plan_grasps`.
        hand: the hand, or its name or folder.
        spec: constraints. Its `table` must be a plane with an `edge` (`Plane.ending`). Its region
            is where the object lies before the drag, and moves with it. The drag counts on the tenth
            quantile of its friction (`DRAG.sure`), if that is a distribution.
        starts: number of random initial guesses of the contact planner.
        seed: random seed.
        task: what grasps must do; None means `GraspTask()`. The greatest mass of a distribution is
            dragged.
        table_friction: coefficient of friction between object and table. The pressing force is
            three times (`DRAG.reserve`) the least one that moves the object (Coulomb's law).

    Raises:
        BadArgument: a table without an edge, or one whose edge is more than 12 mm (`DRAG.behind`)
            behind the object's estimated centre of mass: the object would fall.
        BadArgument: a friction of the fingertips that is not greater than `table_friction`.

    >>> import torch
    >>> from torchgrasp import load_hand, load_object
    >>> from torchgrasp.geometry import Plane
    >>> x = torch.tensor([1.0, 0, 0])
    >>> spec = ContactSpec(table=Plane.horizontal(0.0).ending(0.2 * x, x))
    >>> plan = plan_edge_grasps(load_object("cylinder"), load_hand("barrett"), spec, starts=8)
    """
    table = spec.plane
    if table is None or table.edge is None:
        found = "no table" if table is None else "a table without an edge"
        raise BadArgument("spec.table", found, "a plane with an edge (`Plane.ending`)")
    table = table.to("cpu", torch.float64)
    sure = torch.tensor(DRAG.sure, dtype=torch.float64)
    friction = float(Distribution.of(spec.friction).quantile(sure))
    if not friction > table_friction:
        found = f"{table_friction:g}, and {friction:g} of the fingertips"
        raise BadArgument("table_friction", found, "less than the friction of the fingertips")
    hand = as_hand(hand, "hand")
    request = Request(as_seen(cloud, "cloud"), hand, spec, starts, seed, task=task)
    object_ = ShapedObject.of(request)
    shape = object_.shape.moved(object_.obj_from_upright)
    length = _length(object_, table)
    if length < -2 * DRAG.behind:
        found = f"an edge {-1e3 * (length + DRAG.behind):.0f} mm behind the object's centre"
        raise BadArgument("spec.table", found, "an edge beyond it")
    mass = Distribution.of(request.grasp_task.mass).most
    drag = _find_drag(object_, hand, table, length, mass, friction, table_friction)
    if isinstance(drag, str):
        return EdgePlan(None, plan_shaped(object_, request), shape, drag)
    # for the object, the edge comes nearer
    shift = rigid(torch.eye(3, dtype=torch.float64), drag.displacement)
    nearer = dataclasses.replace(table, edge=table.edge.moved(inverse(shift)))
    obstacles = _brought(object_, drag.displacement)
    object_ = dataclasses.replace(object_, table=nearer, obstacles=obstacles)
    grasps = plan_shaped(object_, request)
    grasps = move(grasps, shift)
    grasps = dataclasses.replace(grasps, meta={**grasps.meta, "table": table.describe()})
    return EdgePlan(drag, grasps, shape.moved(shift))


def _length(object_: ShapedObject, table: Plane) -> float:
    """Return how far [m] the object must be dragged, so that its centre of mass is `DRAG.behind`
    behind the edge. It is negative if the centre is nearer to the edge, or beyond it.
    """
    assert table.edge is not None
    centre = apply(object_.obj_from_upright, object_.body.center.cpu().double()[None])[0]
    return -float(table.edge.height(centre)) - DRAG.behind


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


def _force(mass: float, friction: float, table_friction: float) -> float | None:
    """Return the pressing force [N] that drags an object of a `mass` [kg] (Coulomb's law); None if
    the object is too heavy.

    A force N moves it if the fingers' friction N is at least the table's friction times N plus the
    weight.
    """
    weight = mass * GRAVITY
    least = table_friction * weight / (friction - table_friction)
    if DRAG.enough * least > DRAG.most:
        return None
    return min(max(DRAG.reserve * least, weight, DRAG.least), DRAG.most)


def _find_drag(
    object_: ShapedObject,
    hand: Hand,
    table: Plane,
    length: float,
    mass: float,
    friction: float,
    table_friction: float,
) -> DragPlan | str:
    """Return the drag of a `length` [m] with the best posture that presses on the object, or the
    reason why there is none.
    """
    assert table.edge is not None
    if length <= DRAG.shortest:
        return "the object hangs over the edge as far as it can"
    force = _force(mass, friction, table_friction)
    if force is None:
        return f"an object of {mass:g} kg is too heavy to drag"
    if object_.scene is not None and length > OCCUPANCY.sideways:
        return f"the camera's scene is known only {OCCUPANCY.sideways:g} m around the object"
    postures = press_postures(hand)
    hand = hand.to("cpu", torch.float64)
    frame = object_.obj_from_upright
    outward = table.edge.normal.cpu().double()
    way = length * (inverse(frame)[:3, :3] @ outward)
    if not _is_free(object_, way):
        return "a neighbour is in the object's way to the edge"
    found = _place(object_, hand, postures, way, force)
    if found is None:
        return "no posture of the hand presses on the object from above, clear of all else"
    at, upright_from_press = found
    obj_from_press = frame @ upright_from_press
    presses = postures.presses[at]
    feet = apply(obj_from_press, postures.feet[at])
    return DragPlan(
        joints=postures.joints[at],
        obj_from_hand=obj_from_press @ postures.press_from_hand[at],
        presses=presses,
        feet=torch.where(presses[:, None], feet, torch.nan),
        displacement=length * outward,
        force=force,
        table=table,
    )


def _place(
    object_: ShapedObject,
    hand: Hand,
    postures: PressPostures,
    way: Float[Tensor, "3"],
    force: float,
) -> tuple[int, Float[Tensor, "4 4"]] | None:
    """Return the index of the best pressing posture, and its pose (4, 4) [m] on the object.

    All is in the upright frame, and `way` [m] leads to the edge. None if no posture fits.
    """
    outward = unit(way)
    top = _top(object_)
    centre = object_.body.center.cpu().double()
    places = top.places(centre, outward)
    share = postures.presses.sum(1).double()
    able = flatnonzero(postures.strength >= force / share)
    angles = torch.arange(DRAG.turns, device="cpu").double() * (2 * math.pi / DRAG.turns)
    turns = _turns(angles)  # (t, 3, 3)
    steady = _is_steady(postures, turns.mT @ outward)  # (p, t)
    for tips in (2, 1):
        rows = able[postures.presses[able].sum(1) == tips][: DRAG.postures]
        presses = postures.presses[rows][:, None]
        turned = (turns @ postures.feet[rows][:, None].mT).mT  # (p, t, f, 3)
        for place in places:
            feet = turned + place
            ahead = ((feet - centre) @ outward).where(presses, -math.inf).amax(2)
            height, flat = top.stand(feet)
            low = height.where(presses, math.inf).amin(2)
            high = height.where(presses, -math.inf).amax(2)
            good = steady[rows] & (flat | ~presses).all(2) & (high - low <= DRAG.flat)
            good &= ahead <= DRAG.behind - DRAG.supported
            for p, t in torch.nonzero(good).tolist():
                at = int(rows[p])
                pose = rigid(turns[t], torch.stack([place[0], place[1], high[p, t]]))
                if _is_clear(object_, hand, postures, at, pose, way):
                    return at, pose
    return None


def _is_steady(postures: PressPostures, ways: Float[Tensor, "t 3"]) -> Bool[Tensor, "p t"]:
    """Return whether each posture presses on steadily while it drags along each of `ways`.

    Where a tip sticks, a motion of the palm along the unit vector w changes the tip's force by K w,
    for its stiffness K. So each newton of the drag, w . K w, changes the pressing force by
    -z . K w.
    """
    force = torch.einsum("pfij,tj->ptfi", postures.stiffness, ways)
    along = (force * ways[:, None]).sum(-1)
    change = -force[..., 2] / along
    steady = (change >= -DRAG.unloading) & (change <= DRAG.digging)
    return (steady | ~postures.presses[:, None]).all(2)


def _turns(angles: Float[Tensor, "t"]) -> Float[Tensor, "t 3 3"]:
    """Return the rotations about the vertical by `angles` [rad]."""
    cosine, sine = torch.cos(angles), torch.sin(angles)
    zero, one = torch.zeros_like(angles), torch.ones_like(angles)
    rows = [cosine, -sine, zero, sine, cosine, zero, zero, zero, one]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


class _Top:
    """The top of an object: points all over the triangles of its surface whose normals point up.

    `corners` (v, 3, 3) [m] are those of these triangles.
    """

    def __init__(self, corners: Float[Tensor, "v 3 3"]) -> None:
        from scipy.spatial import KDTree

        longest = float(norm(corners - corners.roll(1, 1)).max()) if len(corners) else 0.0
        parts = min(max(math.ceil(longest / DRAG.near), 1), DRAG.finest)
        self.points = (_middles(parts) @ corners).flatten(0, 1)
        self.height = self.points[:, 2]
        self.tree = KDTree(self.points[:, :2].numpy())
        angles = torch.arange(DRAG.ring, device="cpu").double() * (2 * math.pi / DRAG.ring)
        ring = DRAG.rim * torch.stack([torch.cos(angles), torch.sin(angles)], -1)
        self.around = torch.cat([ring.new_zeros(1, 2), ring])  # (k, 2)

    def places(
        self, centre: Float[Tensor, "3"], outward: Float[Tensor, "3"]
    ) -> Float[Tensor, "k 3"]:
        """Return places [m] on the top, far enough from the edge, those nearest to the `centre`
        first.
        """
        cells = torch.round((self.points - centre)[:, :2] / DRAG.spacing)
        cells = torch.unique(cells, dim=0)
        places = torch.cat([centre[:2] + DRAG.spacing * cells, torch.zeros_like(cells[:, :1])], 1)
        offset = places - centre
        places = places[offset @ outward <= DRAG.behind - DRAG.supported]
        distance = norm((places - centre)[:, :2])
        return places[torch.argsort(distance, stable=True)][: DRAG.places]

    def stand(self, feet: Float[Tensor, "*b 3"]) -> tuple[Float[Tensor, "*b"], Bool[Tensor, "*b"]]:
        """Return the height [m] of the top below each of `feet` [m], and whether it is flat there,
        and away from the outline.
        """
        places = feet[..., None, :2] + self.around
        gap, index = self.tree.query(places.reshape(-1, 2).numpy())
        height = self.height[torch.from_numpy(index)].reshape(places.shape[:-1])
        near = torch.from_numpy(gap).reshape(places.shape[:-1]) <= DRAG.near
        low, high = height.aminmax(dim=-1)
        return height[..., 0], near.all(-1) & (high - low <= DRAG.flat)


def _middles(parts: int) -> Float[Tensor, "k 3"]:
    """Return barycentric coordinates of the middles of the triangles into which three families of
    parallel lines cut a triangle, whose edges they cut into `parts`.
    """
    steps = torch.arange(3 * parts, dtype=torch.float64, device="cpu")
    grid = torch.cartesian_prod(steps, steps)
    grid = torch.cat([grid, 3 * parts - grid.sum(1, keepdim=True)], 1)
    # in thirds of a part, the three coordinates of a middle leave the same rest
    same = (grid % 3 == grid[:, :1] % 3).all(1) & (grid[:, :1] % 3 != 0).all(1)
    return grid[same & (grid > 0).all(1)] / (3 * parts)


def _top(object_: ShapedObject) -> _Top:
    """Return the top of an object, in its upright frame."""
    mesh = object_.surface
    vertices = mesh.vertices.cpu().double()
    corners = vertices[mesh.faces.cpu()]  # (f, 3, 3)
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = torch.linalg.vector_norm(normals, dim=-1).clamp_min(torch.finfo(normals.dtype).tiny)
    upward = normals[:, 2] > DRAG.upward * size
    return _Top(corners[upward])


def _is_free(object_: ShapedObject, way: Float[Tensor, "3"]) -> bool:
    """Return whether no neighbour is in the object's way along the table."""
    if object_.obstacles is None:
        return True
    vertices = object_.surface.vertices.cpu().double()
    path = vertices + _shares()[:, None, None] * way
    field = object_.obstacles.field
    before = field.query(vertices.to(field.nodes))[0].min()
    nearest = field.query(path.flatten(0, 1).to(field.nodes))[0].min()
    # noise of the grid may let the object touch an obstacle where it stands
    return bool(nearest >= torch.clamp(before, max=0.0))


def _shares() -> Float[Tensor, "k"]:
    """Return the shares of the way at which collisions are checked."""
    return torch.linspace(0, 1, DRAG.steps, dtype=torch.float64, device="cpu")


def _is_clear(
    object_: ShapedObject,
    hand: Hand,
    postures: PressPostures,
    at: int,
    pose: Float[Tensor, "4 4"],
    way: Float[Tensor, "3"],
) -> bool:
    """Return whether a hand presses with its pressing tips alone, and keeps clear of all else.

    The hand is in the posture with index `at` at a `pose` [m]. It comes down from above, and moves
    with the object along the `way` [m], clear of the table and of the object's neighbours.
    """
    spheres = hand.collision_spheres
    pressing = flatnonzero(postures.presses[at])
    tips = spheres.touching & torch.isin(spheres.finger, pressing)
    centres = apply(pose, postures.spheres[at])
    radius = spheres.radius.to(centres)
    # under a handle, say, a tip would have to go through the object
    if _gap(object_.body.field, centres[tips], radius[tips]) < -DRAG.sunk:
        return False
    centres, radius = centres[~tips], radius[~tips]
    if float((centres[:, 2] - radius).min()) < DRAG.clear:
        return False
    heights = torch.linspace(0, DRAG.approach, DRAG.lowered, dtype=torch.float64, device="cpu")
    up = torch.eye(3, dtype=torch.float64, device="cpu")[2]
    down = centres + heights[:, None, None] * up
    if _gap(object_.body.field, down, radius) < DRAG.clear:
        return False
    if object_.obstacles is None:
        return True
    path = torch.cat([down, centres + _shares()[:, None, None] * way])
    return _gap(object_.obstacles.field, path, radius) >= DRAG.clear


def _gap(field: DistanceField, path: Float[Tensor, "*k s 3"], radius: Float[Tensor, "s"]) -> float:
    """Return the least clearance [m] of spheres on a path from a field's surface."""
    distance = field.query(path.to(field.nodes))[0].cpu()
    return float((distance - radius.to(distance)).min())
