"""The plan of a drag: where and how a hand presses on an object. Also along which way it moves it.

Searches are in the object's upright frame, on the CPU. Here p counts pressing postures, t
directions about the vertical, and f fingertips.
"""

import dataclasses
import itertools
import math
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.base import Value, flatnonzero
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.lazy import spatial, trimesh
from torchgrasp.foundation.rules import ANY, Pose
from torchgrasp.geometry.frames import apply, inverse, rigid, rotation_from_vector
from torchgrasp.geometry.linalg import norm, unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.signed_distance import DistanceField
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.press import PressPostures, press_postures
from torchgrasp.planner.objects import ShapedObject
from torchgrasp.scene.occupancy import OCCUPANCY
from torchgrasp.values.specs import GRAVITY


@dataclasses.dataclass(frozen=True)
class DragNumbers:
    """Parameters of a drag: the hand presses on an object from above and moves it to the table's
    edge.
    """

    behind: float = 0.015
    """Least distance [m] of the centre of mass behind the table's edge, over the table, at the end
    of the drag.
    """
    unsure: float = 0.25
    """The same distance as a share of the object's extent from its centre towards the edge.
    Estimates of the centre are so far off. The greater distance counts.
    """
    farthest: float = 2.0
    """Greatest distance [m] of the edge from the points of the view: a greater one is in another
    unit.
    """
    supported: float = 0.004
    """Least distance [m] behind the edge of each pressing tip at the end of the drag."""
    spacing: float = 0.008
    """Distance [m] between the places on the object's top where the hand may press."""
    cell: float = 0.001
    """Spacing [m] of the map of the object's top."""
    places: int = 60
    """Greatest number of places to press that are tried, those nearest to the centre of mass."""
    postures: int = 40
    """Number of postures that press with two tips, and number of those with one, that are tried at
    each place.
    """
    turns: int = 24
    """Number of directions about the vertical in which each posture is tried."""
    upward: float = 0.9
    """Least component along the upward direction of the surface's unit normal where a tip presses:
    25 degrees.
    """
    rim: float = 0.002
    """Least distance [m] of a pressing tip from the outline of the object's top."""
    ring: int = 8
    """Number of points on the circle of radius `rim` about a tip that must lie on the object's top.
    """
    flat: float = 0.003
    """Largest difference [m] of heights on this circle."""
    near: float = 0.0025
    """Largest horizontal distance [m] of a node of the map from the nearest sampled point of the
    top. Nodes farther away are beside the top.
    """
    clear: float = 0.003
    """Least clearance [m] of all other links from the object and the table."""
    aside: tuple[float, ...] = (0.0, 30.0, -30.0, 60.0, -60.0)
    """Angles [deg] between the drag and the shortest way to the edge, in the order of trial."""
    lowered: int = 6
    """Number of heights at which the hand is checked on its way down."""
    approach: float = 0.05
    """Height [m] above its pressing pose from which the hand comes down."""
    steps: int = 8
    """Number of places on the way along the table at which hand and object are checked."""
    unloading: float = 0.1
    """Greatest loss [N/N] of pressing force for each newton of the drag: with more the tips would
    slip.
    """
    digging: float = 0.8
    """Greatest gain [N/N] of pressing force for each newton of the drag: with more the tips would
    jam.
    """
    reserve: float = 3.0
    """Wanted ratio of the pressing force to the least one that moves the object."""
    weights: float = 2.0
    """Least ratio of the pressing force to the weight: the tips then resist a turn."""
    pivot: float = 0.004
    """Largest distance [m] of the centre of mass from the line along which one tip drags."""
    share: float = 0.25
    """Share of the friction of two pressing tips that is left to resist a turn of the object."""
    support: float = 0.005
    """Distance [m] before and behind a pressing tip to which the top must reach: else it rolls."""
    carried: float = 1.5
    """Load that the grasps after the drag must resist, as a multiple of the object's weight. The
    excess is because the lever arm of the weight is uncertain by a third.
    """
    least: float = 1.0
    """Least pressing force [N]: sensors are off by 0.1 N."""
    most: float = 20.0
    """Greatest pressing force [N], as thin things bend and hands are weak."""
    enough: float = 1.5
    """Least ratio of `most` to the least pressing force that moves the object. With a smaller ratio
    the object is too heavy.
    """
    sure: float = 0.1
    """Probability that the friction is less than that on which the drag counts."""
    sunk: float = 0.005
    """Greatest depth [m] of a pressing tip in the estimated shape: estimates are a few mm off."""
    ended: float = 0.85
    """Factor on the predicted success of a grasp after a drag: the share of simulated drags that
    ended as planned.
    """
    shortest: float = 0.002
    """Length [m] up to which a drag is not worth while: sensors are off by as much."""


DRAG = DragNumbers()


@checked
@dataclasses.dataclass(frozen=True)
class DragPlan(Value):
    """How a hand drags an object along its table: it presses from above, and moves sideways.

    Everything is in the frame of the cloud. f counts fingertips, and h actuated joints.

    Attributes:
        joints: positions (h,) [rad or m] of the actuated joints of the pressing hand. They stay the
            same during the drag.
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


def find_drag(
    object_: ShapedObject,
    hand: Hand,
    table: Plane,
    mass: float,
    friction: float,
    table_friction: float,
) -> DragPlan | str:
    """Return a drag of an object to its table's edge; without one, a text with the reason.

    It is the first drag that is found. Two pressing tips are tried before one, and the shortest way
    to the edge before ways aslant.

    Args:
        object_: the object on its table, with its estimated shape.
        hand: the hand.
        table: the table, with an edge, in the frame of the cloud; in float64 on the CPU.
        mass: mass [kg] of the object.
        friction: coefficient of friction between fingertips and object.
        table_friction: coefficient of friction between object and table.
    """
    balance = EdgeBalance.of(object_, table)
    if balance.length <= DRAG.shortest:
        return "the object hangs over the edge as far as it can"
    force = pressing_force(mass, friction, table_friction)
    if force is None:
        return f"an object of {mass:g} kg is too heavy to drag"
    if object_.scene is not None and balance.length > OCCUPANCY.sideways:
        return f"the camera's scene is known only {OCCUPANCY.sideways:g} m around the object"
    # displacements in the frame of the cloud, beside those in the upright frame
    frame = object_.obj_from_upright
    turned = inverse(frame)[:3, :3]
    ways = [(way, turned @ way) for way in _ways(table, balance.length)]
    ways = [(way, upright) for way, upright in ways if _is_free(object_, upright)]
    if not ways:
        return "a neighbour is in the object's way to the edge"
    no_posture = "no posture of the hand presses on the object from above, clear of all else"
    corners = _facing_up(object_)
    if not len(corners):
        return no_posture
    # the torque of the weight's friction, over the friction that is left to two tips
    lever = 2 * table_friction * mass * GRAVITY / (DRAG.share * friction * force)
    postures = press_postures(hand)
    hand = hand.to("cpu", torch.float64)
    search = _PressSearch(object_, hand, postures, balance, _Top(corners), force, lever)
    # two tips resist a turn of the object; a narrow one would roll unless it is dragged along
    for tips, (displacement, way) in itertools.product((2, 1), ways):
        found = search.place(tips, way)
        if found is None:
            continue
        at, upright_from_press = found
        obj_from_press = frame @ upright_from_press
        presses = postures.presses[at]
        feet = apply(obj_from_press, postures.feet[at])
        return DragPlan(
            joints=postures.joints[at],
            obj_from_hand=obj_from_press @ postures.press_from_hand[at],
            presses=presses,
            feet=torch.where(presses[:, None], feet, torch.nan),
            displacement=displacement,
            force=force,
            table=table,
        )
    return no_posture


def _ways(table: Plane, length: float) -> list[Float[Tensor, "3"]]:
    """Return the displacements [m] that bring an object nearer to a table's edge by a `length` [m]:
    the shortest, then aslant.
    """
    assert table.edge is not None
    ways = list[Float[Tensor, "3"]]()
    for angle in map(math.radians, DRAG.aside):
        turn = rotation_from_vector(angle * table.normal)
        ways.append((length / math.cos(angle)) * (turn @ table.edge.normal))
    return ways


@dataclasses.dataclass(frozen=True)
class EdgeBalance:
    """Where the weight of an object acts, and how far the object may go over the table's edge.

    The object's upright frame has a z axis that points up.

    Attributes:
        centre: estimated centre of mass (3,) [m] in the upright frame.
        edge: horizontal unit vector (3,) towards the edge in the upright frame.
        away: distance [m] of the centre from the edge; negative if it is beyond the edge.
        behind: distance [m] from the edge, over the table, at which the centre shall end.
    """

    centre: Float[Tensor, "3"]
    edge: Float[Tensor, "3"]
    away: float
    behind: float

    @classmethod
    def of(cls, object_: ShapedObject, table: Plane) -> "EdgeBalance":
        """Return where an object's weight acts, and how far the object may go over its table's
        edge.

        The `table` has an edge, and is in the frame of the cloud.
        """
        assert table.edge is not None
        centre = centre_of_mass(object_)
        edge = inverse(object_.obj_from_upright)[:3, :3] @ table.edge.normal
        in_cloud = apply(object_.obj_from_upright, centre[None])[0]
        away = -float(table.edge.height(in_cloud))
        reach = float(((_vertices(object_) - centre) @ edge).max())
        return cls(centre, edge, away, max(DRAG.behind, DRAG.unsure * reach))

    @property
    def length(self) -> float:
        """How far [m] the object must be dragged towards the edge; negative if its centre of mass
        is already nearer to the edge than it should be.
        """
        return self.away - self.behind


def pressing_force(mass: float, friction: float, table_friction: float) -> float | None:
    """Return the pressing force [N] that drags an object of a `mass` [kg] (Coulomb's law); None if
    the object is too heavy.

    A normal force N moves the object if m N >= t (N + W). Here m is the coefficient `friction` of
    the fingers, t that of the table, and W the weight. The result is three times the least N, or
    twice the weight if that is more. It is from 1 to 20 N. An object is too heavy if 1.5 times the
    least N exceeds 20 N.
    """
    weight = mass * GRAVITY
    least = table_friction * weight / (friction - table_friction)
    if DRAG.enough * least > DRAG.most:
        return None
    return min(max(DRAG.reserve * least, DRAG.weights * weight, DRAG.least), DRAG.most)


def centre_of_mass(object_: ShapedObject) -> Float[Tensor, "3"]:
    """Return the centroid [m] of the volume within the estimated surface, in the upright frame.

    Each triangle and the mean vertex span a tetrahedron. The centroid is the mean of the
    tetrahedra's centroids, with their signed volumes as weights.
    """
    vertices = _vertices(object_)
    middle = vertices.mean(0)
    corners = (vertices - middle)[object_.surface.faces.cpu()]  # (f, 3, 3)
    volumes = torch.linalg.det(corners)
    return middle + (volumes[:, None] * corners.sum(1)).sum(0) / (4 * volumes.sum())


@dataclasses.dataclass(frozen=True)
class _PressSearch:
    """The search for a pressing posture and its place on an object.

    Attributes:
        object_: the object.
        hand: the hand, in float64 on the CPU.
        postures: its pressing postures.
        balance: where the weight of the object acts.
        top: the map of the object's top.
        force: sum of the normal forces [N] of the pressing tips.
        lever: least ratio of the distance of two tips to that of the centre of mass from their
            line of drag.
    """

    object_: ShapedObject
    hand: Hand
    postures: PressPostures
    balance: EdgeBalance
    top: "_Top"
    force: float
    lever: float

    def place(self, tips: int, way: Float[Tensor, "3"]) -> tuple[int, Float[Tensor, "4 4"]] | None:
        """Return the index of the best posture with one or two pressing `tips`, and its pose (4, 4)
        [m] on the object. Return None if no posture fits.

        `way` [m] is the displacement of hand and object, in the upright frame.
        """
        outward = unit(way)
        sideways = torch.stack([-outward[1], outward[0], torch.zeros_like(outward[0])])
        count = self.postures.presses.sum(1)
        able = (count == tips) & (self.postures.strength >= self.force / tips)
        rows = flatnonzero(able)[: DRAG.postures]
        postures = self.postures[rows]
        turns = _turns()  # (t, 3, 3)
        steady = _is_steady(postures, turns.mT @ outward)  # (p, t)
        turned = (turns @ postures.feet[:, None].mT).mT  # (p, t, f, 3)
        presses = postures.presses[:, None]  # (p, 1, f)
        # places that are still over the table at the end of the drag
        centre = self.balance.centre
        edge = self.balance.edge
        most = self.balance.behind - DRAG.supported
        stands = self.top.stands(outward)
        places = self.top.places(stands, centre)
        places = places[(places - centre) @ edge <= most][: DRAG.places]
        for place in places:
            # two tips far apart resist a turn, or one on a line with the centre of mass
            off = abs(float((centre - place) @ sideways))
            if tips == 1 and off > DRAG.pivot:
                continue
            straight = self.lever * off <= postures.apart
            # each pressing tip ends over the table, and stands on a flat top at the same height
            feet = turned + place
            ahead = ((feet - centre) @ edge).where(presses, -math.inf).amax(2)
            height, flat = self.top.look(stands, feet[..., :2])
            low = height.where(presses, math.inf).amin(2)
            high = height.where(presses, -math.inf).amax(2)
            good = straight[:, None] & steady & (flat | ~presses).all(2)
            good &= (high - low <= DRAG.flat) & (ahead <= most)
            for p, t in torch.nonzero(good).tolist():
                at = int(rows[p])
                pose = rigid(turns[t], torch.stack([place[0], place[1], high[p, t]]))
                if self.is_clear(at, pose, way):
                    return at, pose
        return None

    def is_clear(self, at: int, pose: Float[Tensor, "4 4"], way: Float[Tensor, "3"]) -> bool:
        """Return whether a hand presses with its pressing tips alone, and keeps clear of all else.

        The hand is in the posture with index `at` at a `pose` [m]. It comes down from above, and
        moves with the object along the `way` [m]. Table and neighbours must not be in its way.
        """
        spheres = self.hand.collision_spheres
        pressing = flatnonzero(self.postures.presses[at])
        tips = spheres.touching & torch.isin(spheres.finger, pressing)
        centres = apply(pose, self.postures.spheres[at])
        radius = spheres.radius.to(centres)
        # under a handle, say, a tip would have to go through the object
        if _gap(self.object_.body.field, centres[tips], radius[tips]) < -DRAG.sunk:
            return False
        centres = centres[~tips]
        radius = radius[~tips]
        if float((centres[:, 2] - radius).min()) < DRAG.clear:
            return False
        heights = torch.linspace(0, DRAG.approach, DRAG.lowered, dtype=torch.float64, device="cpu")
        up = torch.eye(3, dtype=torch.float64, device="cpu")[2]
        down = centres + heights[:, None, None] * up
        if _gap(self.object_.body.field, down, radius) < DRAG.clear:
            return False
        if self.object_.obstacles is None:
            return True
        path = torch.cat([down, _along(centres, way)])
        return _gap(self.object_.obstacles.field, path, radius) >= DRAG.clear


def _is_steady(postures: PressPostures, ways: Float[Tensor, "t 3"]) -> Bool[Tensor, "p t"]:
    """Return whether each posture presses on steadily while it drags along each of `ways`.

    A tip may stick. Then a motion of the palm along the unit vector w changes the tip's force by K
    w. Here K is the tip's stiffness. So each newton of the drag, w . K w, changes the pressing
    force by -z . K w.
    """
    force = torch.einsum("pfij,tj->ptfi", postures.stiffness, ways)
    along = (force * ways[:, None]).sum(-1)
    change = -force[..., 2] / along
    steady = (change >= -DRAG.unloading) & (change <= DRAG.digging)
    return (steady | ~postures.presses[:, None]).all(2)


def _angles(count: int) -> Float[Tensor, "t"]:
    """Return `count` equal steps around a circle [rad], from 0."""
    return torch.arange(count, device="cpu").double() * (2 * math.pi / count)


def _turns() -> Float[Tensor, "t 3 3"]:
    """Return the rotations about the vertical by `DRAG.turns` equal steps."""
    angles = _angles(DRAG.turns)
    cosine = torch.cos(angles)
    sine = torch.sin(angles)
    zero = torch.zeros_like(angles)
    one = torch.ones_like(angles)
    rows = [cosine, -sine, zero, sine, cosine, zero, zero, zero, one]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


class _Top:
    """A map of an object's top, seen from above, on a grid with the spacing `DRAG.cell` [m].

    Args:
        corners: those of the triangles (k, 3, 3) [m] of the surface that face up.

    Attributes:
        nodes: the nodes (n, m, 2) [m] of the grid.
        height: height (n, m) [m] of the top at each node.
        seen: whether the top is at each node (n, m).
    """

    def __init__(self, corners: Float[Tensor, "k 3 3"]) -> None:
        # points all over the triangles
        faces = np.arange(3 * len(corners)).reshape(-1, 3)
        vertices = corners.flatten(0, 1).numpy()
        dense = trimesh.remesh.subdivide_to_size(vertices, faces, max_edge=DRAG.near)[0]
        points = torch.from_numpy(dense)
        margin = DRAG.rim + DRAG.support + DRAG.cell
        self.low = points[:, :2].amin(0) - margin
        size = ((points[:, :2].amax(0) + margin - self.low) / DRAG.cell).ceil().long() + 1
        steps = [torch.arange(int(count), device="cpu").double() for count in size]
        self.nodes = self.low + DRAG.cell * torch.stack(torch.meshgrid(*steps, indexing="ij"), -1)
        gap, index = spatial.KDTree(points[:, :2].numpy()).query(self.nodes.numpy())
        self.height = points[torch.from_numpy(index), 2]
        self.seen = torch.from_numpy(gap) <= DRAG.near

    def look(
        self, good: Bool[Tensor, "n m"], places: Float[Tensor, "*b 2"]
    ) -> tuple[Float[Tensor, "*b"], Bool[Tensor, "*b"]]:
        """Return the height [m] of the top at the nodes nearest to `places` [m], and the map `good`
        there. Beyond the maps nothing is good.
        """
        index = ((places - self.low) / DRAG.cell).round().long()
        size = torch.tensor(good.shape, device="cpu")
        inside = ((index >= 0) & (index < size)).all(-1)
        row, column = torch.where(inside[..., None], index, 0).unbind(-1)
        return self.height[row, column], good[row, column] & inside

    def stands(self, outward: Float[Tensor, "3"]) -> Bool[Tensor, "n m"]:
        """Return whether a tip that drags along the unit vector `outward` can press at each node.
        It can where the top is flat around it.
        """
        angles = _angles(DRAG.ring)
        ring = DRAG.rim * torch.stack([torch.cos(angles), torch.sin(angles)], -1)
        # before and behind the tip the top must reach farther
        along = DRAG.support * torch.stack([outward[:2], -outward[:2]])
        around = torch.cat([ring.new_zeros(1, 2), ring, along])
        height, seen = self.look(self.seen, self.nodes[..., None, :] + around)
        low, high = height.aminmax(dim=-1)
        return seen.all(-1) & (high - low <= DRAG.flat)

    def places(
        self, stands: Bool[Tensor, "n m"], centre: Float[Tensor, "3"]
    ) -> Float[Tensor, "k 3"]:
        """Return places [m] where a tip `stands`, those nearest to the `centre` first."""
        nodes = self.nodes[stands]
        cells = torch.round((nodes - centre[:2]) / DRAG.spacing)
        _, cell = torch.unique(cells, dim=0, return_inverse=True)
        count = torch.bincount(cell)
        places = torch.zeros(len(count), 3, dtype=torch.float64, device="cpu")
        # the mean of the nodes in each cell: on a narrow object it lies on its ridge
        places[:, :2].index_add_(0, cell, nodes)
        places = places / count[:, None]
        distance = norm((places - centre)[:, :2])
        return places[torch.argsort(distance, stable=True)]


def _vertices(object_: ShapedObject) -> Float[Tensor, "v 3"]:
    """Return the vertices [m] of an object's surface, in float64 on the CPU."""
    return object_.surface.vertices.cpu().double()


def _facing_up(object_: ShapedObject) -> Float[Tensor, "k 3 3"]:
    """Return the corners [m] of the triangles of an object's surface that face up."""
    vertices = _vertices(object_)
    corners = vertices[object_.surface.faces.cpu()]  # (f, 3, 3)
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = norm(normals).clamp_min(torch.finfo(normals.dtype).tiny)
    return corners[normals[:, 2] > DRAG.upward * size]


def _is_free(object_: ShapedObject, way: Float[Tensor, "3"]) -> bool:
    """Return whether no neighbour is in the object's way along the table."""
    if object_.obstacles is None:
        return True
    vertices = _vertices(object_)
    path = _along(vertices, way)
    field = object_.obstacles.field
    before = field.query(vertices.to(field.nodes))[0].min()
    nearest = field.query(path.flatten(0, 1).to(field.nodes))[0].min()
    # noise of the grid may let the object touch an obstacle where it stands
    return bool(nearest >= torch.clamp(before, max=0.0))


def _along(points: Float[Tensor, "n 3"], way: Float[Tensor, "3"]) -> Float[Tensor, "k n 3"]:
    """Return points [m] at the k places along their way at which collisions are checked."""
    shares = torch.linspace(0, 1, DRAG.steps, dtype=torch.float64, device="cpu")
    return points + shares[:, None, None] * way


def _gap(field: DistanceField, path: Float[Tensor, "*k s 3"], radius: Float[Tensor, "s"]) -> float:
    """Return the least clearance [m] of spheres on a path from a field's surface."""
    distance = field.query(path.to(field.nodes))[0].cpu()
    return float((distance - radius.to(distance)).min())
