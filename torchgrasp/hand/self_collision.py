"""Self-collision of a hand by the collision shapes of its URDF, which are what a simulator sees.

The sign is exact for boxes and balls: two boxes overlap unless one of 15 axes parts them. A cylinder is taken as a
prism of twelve sides, which is off by 2 % of its radius.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.frames import rotation_from_rpy
from torchgrasp.hand.box_distance import box_distance, box_separation
from torchgrasp.hand.kinematics import map_points
from torchgrasp.hand.urdf import Shape, Triple, Urdf

PRISM = 6
"""Boxes that a cylinder is the union of: each reaches from one side of the prism to the opposite one."""


@dataclasses.dataclass(frozen=True)
class SelfCollision(Value):
    """Boxes and balls fixed to links, in link frames [m], and the pairs of them to test.

    A ball has a `radius` and `half` sizes of 0; a box has `half` sizes and a radius of 0. In `pairs` those of two boxes
    come first, then those of a ball and a box, in this order, then those of two balls: `kinds` counts each.
    """

    link: Int[Tensor, " s"]
    turn: Float[Tensor, "3 3 s"]
    center: Float[Tensor, "s 3"]
    half: Float[Tensor, "s 3"]
    radius: Float[Tensor, " s"]
    pairs: Int[Tensor, "p 2"]
    kinds: tuple[int, int, int]

    def clearance(self, frames: Float[Tensor, "3 4 l n"], below: float = torch.inf) -> Float[Tensor, " n"]:
        """Return the signed least separation [m] of the pairs; infinite for a hand without pairs.

        A pair is evaluated where it can be the least: where the balls around its shapes are not farther apart than
        the balls inside the shapes of some pair, nor than `below`. What is not below that is some larger number.
        """
        least = frames.new_full(frames.shape[3:], torch.inf)
        if not len(self.pairs):
            return least
        shapes = self._place(frames)
        with torch.no_grad():
            distance = self._distances(shapes[1])
            inner = self.half.amin(1) + self.radius
            limit = (distance - self._sums(inner, distance)).amin(0).clamp_max(below)
            pair, row = torch.nonzero(distance - self._sums(self._outer(), distance) <= limit, as_tuple=True)
        return least.scatter_reduce(0, row, self._separations(shapes, pair, row), "amin")

    def separations(self, frames: Float[Tensor, "3 4 l n"], below: float) -> Float[Tensor, "p n"]:
        """Return the separation [m] of each pair where it can be less than `below`, else that of balls around it."""
        shapes = self._place(frames)
        distance = self._distances(shapes[1])
        apart = distance - self._sums(self._outer(), distance)
        pair, row = torch.nonzero(apart < below, as_tuple=True)
        return apart.index_put((pair, row), self._separations(shapes, pair, row))

    def wrenches(
        self, frames: Float[Tensor, "3 4 l n"], pair: Int[Tensor, " k"], row: Int[Tensor, " k"]
    ) -> Float[Tensor, "6 k"]:
        """Return the derivative of separations by a motion of the pair's second shape (translation, rotation).

        As a wrench (force, torque about the frames' origin) it is what parts the two, and its negative acts on the
        first shape.
        """
        if not len(pair):
            return frames.new_zeros(6, 0)
        turn, center = (x.detach() for x in self._place(frames))
        with torch.enable_grad():
            twist = turn.new_zeros(6, len(pair), requires_grad=True)
            return torch.autograd.grad(self._separations((turn, center), pair, row, twist).sum(), twist)[0]

    def _place(self, frames: Float[Tensor, "3 4 l n"]) -> tuple[Float[Tensor, "3 3 s n"], Float[Tensor, "3 s n"]]:
        """Return the shapes' axes and centres in the palm's frame."""
        links, turn = frames.index_select(2, self.link), self.turn.to(frames)[..., None]
        axes = links[:, 0, None] * turn[0] + links[:, 1, None] * turn[1] + links[:, 2, None] * turn[2]
        return axes, map_points(links, self.center)

    def _distances(self, center: Float[Tensor, "3 s n"]) -> Float[Tensor, "p n"]:
        """Return how far the centres of each pair are apart."""
        first, second = self.pairs.unbind(1)
        return _length(center.index_select(1, second) - center.index_select(1, first))

    def _outer(self) -> Float[Tensor, " s"]:
        """Return the radii of the balls around the shapes."""
        return torch.linalg.vector_norm(self.half, dim=1) + self.radius

    def _sums(self, radius: Float[Tensor, " s"], like: Tensor) -> Float[Tensor, "p 1"]:
        """Return the sums of radii over the pairs."""
        return radius[self.pairs].sum(1, keepdim=True).to(like)

    def _separations(
        self,
        shapes: tuple[Float[Tensor, "3 3 s n"], Float[Tensor, "3 s n"]],
        pair: Int[Tensor, " k"],
        row: Int[Tensor, " k"],
        twist: Float[Tensor, "6 k"] | None = None,
    ) -> Float[Tensor, " k"]:
        """Return the separation of chosen pairs in chosen rows, after a small twist of the second shapes."""
        found = shapes[1].new_zeros(len(pair))
        low = 0
        for kind, count in enumerate(self.kinds):
            at = torch.nonzero((pair >= low) & (pair < low + count))[:, 0]
            if len(at):
                some = self._of_kind(kind, shapes, pair[at], row[at], None if twist is None else twist[:, at])
                found = found.index_put((at,), some)
            low += count
        return found

    def _of_kind(
        self,
        kind: int,
        shapes: tuple[Float[Tensor, "3 3 s n"], Float[Tensor, "3 s n"]],
        pair: Int[Tensor, " k"],
        row: Int[Tensor, " k"],
        twist: Float[Tensor, "6 k"] | None,
    ) -> Float[Tensor, " k"]:
        """Return the separation of pairs of one kind."""
        turn, center, n = shapes[0].flatten(2), shapes[1].flatten(1), shapes[1].shape[2]
        half, radius, outer = (x.to(center) for x in (self.half.T, self.radius, self._outer()))
        first, second = self.pairs[pair].unbind(1)
        one, two = first * n + row, second * n + row
        place, axes = center.index_select(1, two), turn.index_select(2, two)
        if twist is not None:
            place = place + twist[:3] + torch.linalg.cross(twist[3:], place, dim=0)
            axes = axes + torch.linalg.cross(twist[3:, None].expand_as(axes), axes, dim=0)
        gap = place - center.index_select(1, one)
        if kind == 1:
            inside = axes[0] * gap[0] + axes[1] * gap[1] + axes[2] * gap[2]
            return box_distance(inside.T, half[:, second].T) - radius[first]
        apart = _length(gap) - outer[first] - outer[second]
        if kind == 2:
            return apart
        return torch.maximum(
            apart, box_separation(turn.index_select(2, one), axes, gap, half[:, first], half[:, second])
        )


def _length(v: Float[Tensor, "3 *b"]) -> Float[Tensor, "*b"]:
    """Return the length of vectors; its derivative is 0 where it is."""
    squared = torch.addcmul(torch.addcmul(v[0] * v[0], v[1], v[1]), v[2], v[2])
    return torch.sqrt(squared.clamp_min(1e-24))


def self_collision_from_urdf(urdf: Urdf, linked: Iterable[tuple[str, str]] | None) -> SelfCollision:
    """List the pairs of shapes to test.

    Args:
        urdf: the hand's tree with its collision shapes.
        linked: pairs of links to test; by default all but those that share a joint.
    """
    if linked is None:
        joined = {frozenset((j.parent, j.child)) for j in urdf.joints}
        every = itertools.combinations([x.name for x in urdf.links], 2)
        linked = [pair for pair in every if frozenset(pair) not in joined]
    tested = {frozenset(pair) for pair in linked}
    shapes = [(i, x.name, *part) for i, x in enumerate(urdf.links) for shape in x.shapes for part in _parts(shape)]
    kinds: tuple[list[tuple[int, int]], ...] = ([], [], [])
    for one, two in itertools.combinations(range(len(shapes)), 2):
        if frozenset((shapes[one][1], shapes[two][1])) in tested:
            balls = [shapes[k][5] > 0 for k in (one, two)]
            kinds[sum(balls)].append((two, one) if balls == [False, True] else (one, two))
    return SelfCollision(
        link=torch.tensor([s[0] for s in shapes], dtype=torch.long),
        turn=torch.stack([s[2] for s in shapes], -1) if shapes else torch.zeros(3, 3, 0, dtype=torch.float64),
        center=torch.tensor([s[3] for s in shapes], dtype=torch.float64).reshape(-1, 3),
        half=torch.tensor([s[4] for s in shapes], dtype=torch.float64).reshape(-1, 3),
        radius=torch.tensor([s[5] for s in shapes], dtype=torch.float64),
        pairs=torch.tensor([pair for kind in kinds for pair in kind], dtype=torch.long).reshape(-1, 2),
        kinds=(len(kinds[0]), len(kinds[1]), len(kinds[2])),
    )


def _parts(shape: Shape) -> list[tuple[Float[Tensor, "3 3"], Triple, Triple, float]]:
    """Return the boxes and balls that a shape is the union of: rotation, centre, half sizes, radius."""
    turn = rotation_from_rpy(shape.rpy)
    if shape.kind == "sphere":
        return [(turn, shape.xyz, (0.0, 0.0, 0.0), shape.size[0])]
    if shape.kind == "box":
        x, y, z = shape.size
        return [(turn, shape.xyz, (x / 2, y / 2, z / 2), 0.0)]
    step = math.pi / PRISM
    corner = 2 * shape.size[0] / (1 + math.cos(step / 2))  # as far outside the circle as the sides are inside
    half = (corner * math.cos(step / 2), corner * math.sin(step / 2), shape.size[1] / 2)
    return [(turn @ rotation_from_rpy((0.0, 0.0, k * step)), shape.xyz, half, 0.0) for k in range(PRISM)]
