"""Exact signed separations between the links of a hand, whose shapes are boxes and spheres.

s counts shapes, p pairs of shapes, n postures, and k chosen combinations of pair and posture.
`Frames` (3, 4, l, n) are the poses (3 x 4) [m] of l links in n postures, in any one frame.
Positions [m] are then in this frame, too.
"""

import dataclasses
import itertools
from collections.abc import Callable
from functools import cached_property
from typing import Annotated, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.base import Value, flatnonzero, kept, row_numbers
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Range, is_known
from torchgrasp.hand.kinematics import Frames, map_points

# largest separation [m] that is needed exactly
Bound = Annotated[float, Range(-torch.inf, torch.inf, "a number")]
# unit axes and centres [m] of s shapes in n postures
Placed = tuple[Float[Tensor, "3 3 s n"], Float[Tensor, "3 s n"]]
LEAST_SQUARE = 1e-24  # least squared length [m2]: the derivative of its root is finite
PARALLEL_EDGES = 1e-10  # squared sine below which edges are parallel
Pushed = tuple[Float[Tensor, "3 c"], Float[Tensor, "3 c"]]
"""Of c pairs of shapes: unit directions that push the second shape out of the first one, and contact
points [m].
"""
Push = Callable[[Int[Tensor, " c"]], Pushed]
"""Function of the indices (c,) of some pairs of shapes, which returns how they are pushed apart."""


class Chosen(NamedTuple):
    """k chosen combinations of a pair of shapes with a posture of the hand, sorted by pair.

    `pair[i]` is the index of a pair in `SelfCollision.pairs`, and `row[i]` that of a posture. Pairs
    of one kind are neighbours, so `parts` gives each kind a slice.
    """

    pair: Int[Tensor, " k"]  # indices in `SelfCollision.pairs`
    row: Int[Tensor, " k"]  # indices of postures
    # (kind, slice of the k combinations) of each kind that occurs. The kind is the number of
    # spheres in a pair: 0 is box-box, 1 sphere-box, 2 sphere-sphere.
    parts: list[tuple[int, slice]]


@dataclasses.dataclass(frozen=True)
class SelfCollision(Value):
    """Boxes and spheres on the links of a hand, and the p pairs of them that are tested for
    collision.

    A `Hand` holds it as `self_collision`. s counts the shapes.

    Attributes:
        link: index (s,) of the link of each shape, in `Hand.tree.link_names`.
        rotation: rotation matrices (3, 3, s). The columns of `rotation[:, :, k]` are the axes of
            box k in its link's frame.
        center: centre (s, 3) [m] of each shape, in its link's frame.
        half: half sizes (s, 3) [m] of each box; 0 for a sphere.
        radius: radius (s,) [m] of each sphere; 0 for a box.
        pairs: indices (p, 2) of the two shapes of each pair. Box-box pairs come first, then
            sphere-box pairs, then sphere-sphere pairs.
        kinds: numbers of box-box, sphere-box and sphere-sphere pairs.

    In the methods, `frames` (3, 4, l, n) are the poses [m] of the l links in n postures. All are in
    one frame. `Hand.tree.frames` returns them. A negative separation is minus the shortest
    translation that separates two shapes. A positive separation is a lower bound of their distance,
    exact where a face is nearest.

    >>> from torchgrasp import load_hand
    >>> hand = load_hand("barrett")
    >>> links = hand.self_collision
    >>> frames = hand.tree.frames(hand.expand_joints(hand.lower[None]).T)
    >>> torch.allclose(links.clearance(frames), links.separations(frames, torch.inf).amin(0))
    True
    """

    link: Int[Tensor, " s"]
    rotation: Float[Tensor, "3 3 s"]
    center: Float[Tensor, "s 3"]
    half: Float[Tensor, "s 3"]
    radius: Float[Tensor, " s"]
    pairs: Int[Tensor, "p 2"]
    kinds: tuple[int, int, int]

    @checked(gradients=True)
    def clearance(self, frames: Frames, below: Bound = torch.inf) -> Float[Tensor, " n"]:
        """Return the least signed separation (n,) [m] over all pairs of shapes, in each of n
        postures.

        A negative value means overlap. The result is infinite if there are no pairs.

        Args:
            frames: poses (3, 4, l, n) [m] of the l links, from `Hand.tree.frames`.
            below: separation [m] up to which results are needed. Where the least separation is
                greater, the result is any number of at least `below`, or infinity.

        Raises `BadArgument` if `frames` has too few links.
        """
        least = frames.new_full(frames.shape[3:], torch.inf)
        if not len(self.pairs):
            return least
        shapes = self._place(frames)
        with torch.no_grad():  # the spheres show which pairs can be the nearest
            distance = self._distances(shapes[1])
            inscribed = self.half.amin(1) + self.radius
            touching = inscribed[self.pairs].sum(1, keepdim=True).to(distance)
            limit = (distance - touching).amin(0).clamp_max(below)
            near = distance - self._bounding_sums.to(distance) <= limit
            # torch.vmap cannot select entries: all are chosen, by a mask that it does not see
            dense = not torch.compiler.is_compiling() and not is_known(near)
            every = torch.ones(near.shape, dtype=torch.bool, device=near.device) if dense else near
            chosen = self._choose(every)
        apart = self._separations(shapes, chosen)
        if dense:
            apart = torch.where(near[chosen.pair, chosen.row], apart, torch.inf)
        return least.scatter_reduce(0, chosen.row, apart, "amin")

    @checked
    def separations(self, frames: Frames, below: Bound) -> Float[Tensor, "p n"]:
        """Return the signed separation (p, n) [m] of each of the p `pairs` of shapes, in each of n
        postures.

        A negative value means overlap: it is minus the shortest translation that separates the
        shapes. A positive value is a lower bound of the distance.

        Args:
            frames: poses (3, 4, l, n) [m] of the l links, from `Hand.tree.frames`.
            below: separation [m] up to which results are needed. Pairs whose bounding spheres are
                farther apart get the separation of these spheres, a lower bound.

        Raises `BadArgument` if `frames` has too few links, and inside `torch.vmap`.
        """
        shapes, apart, chosen = self._near(frames, below)
        return apart.index_put(chosen[:2], self._separations(shapes, chosen))

    @checked
    def pushes(
        self, frames: Frames, below: Bound
    ) -> tuple[Float[Tensor, "p n"], Int[Tensor, "p n"], Float[Tensor, "6 k"]]:
        """Return (separations, index, wrenches): how far the p pairs of shapes are apart, and how
        motion changes this.

        * `separations` (p, n) [m] are those of the method `separations`, in n postures.
        * `index` (p, n) is the column in `wrenches` of each pair in each posture. Pairs may share
          one.
        * `wrenches` (6, k) has k columns. A column is the derivative of a separation with respect
          to a motion of the pair's second shape. Rows 0 to 2 are for its translation (no unit).
          Rows 3 to 5 [m/rad] are for its rotation about the origin. Axes and origin are those of
          the frame of `frames`.

        The wrench of a pair that is at least `below` apart is zero.

        Args:
            frames: poses (3, 4, l, n) [m] of the l links, from `Hand.tree.frames`.
            below: separation [m] up to which pairs have a wrench.

        Raises `BadArgument` if `frames` has too few links, and inside `torch.vmap`.
        """
        shapes, apart, (pair, row, parts) = self._near(frames, below)
        separation = apart.new_zeros(len(pair))
        wrench = apart.new_zeros(6, len(pair) + 1)
        for kind, at in parts:
            separation[at], push = self._of_kind(kind, shapes, pair[at], row[at])
            is_close = separation[at] < below
            if pair.device.type == "cpu":
                close = flatnonzero(is_close)
            else:  # wrenches of all cost less than a wait
                close = torch.arange(at.stop - at.start, device=pair.device)
            if len(close):
                force, point = push(close)
                force = force * is_close[close].to(force)
                torque = torch.linalg.cross(point, force, dim=0)
                wrench[:, at.start + close] = torch.cat([force, torque])
        number = torch.full_like(apart, len(pair), dtype=torch.long)
        number[pair, row] = row_numbers(pair)
        return apart.index_put((pair, row), separation), number, wrench

    @checked(gradients=True)
    def count_near(self, frames: Frames, below: Bound) -> int:
        """Return the number of pairs of shapes whose bounding spheres are nearer than `below` [m],
        summed over n postures. Only for these pairs does `separations` compare the shapes
        themselves.

        Args:
            frames: poses (3, 4, l, n) [m] of the l links, from `Hand.tree.frames`.
            below: separation [m] of bounding spheres.

        Raises `BadArgument` if `frames` has too few links, and inside `torch.vmap`.
        """
        return len(self._near(frames, below)[2].pair)

    @checked
    def only(self, kept: Bool[Tensor, " p"]) -> "SelfCollision":
        """Return a copy with the same shapes, but only with the pairs of shapes that the mask
        `kept` (p,) selects.
        """
        one, two, three = (int(kind.sum()) for kind in kept.split(self.kinds))
        return dataclasses.replace(self, pairs=self.pairs[kept], kinds=(one, two, three))

    def link_pairs(self) -> list[tuple[int, int]]:
        """Return the pairs of links that are tested for collision, each once and sorted. A pair
        holds two indices in `Hand.tree.link_names`.
        """
        links = self.link[self.pairs].sort(1).values
        return [(one, two) for one, two in torch.unique(links, dim=0).tolist()]

    def _place(self, frames: Frames) -> Placed:
        """Return the shapes' axes and centres [m] in the frame of the link `frames`."""
        if frames.shape[2] < self._links:
            raise BadArgument("frames", f"{frames.shape[2]} links", f"at least {self._links} links")
        links = frames.index_select(2, self.link)
        rotation = self.rotation.to(frames)[..., None]
        axes = links[:, 0, None] * rotation[0]
        axes = axes + links[:, 1, None] * rotation[1]
        axes = axes + links[:, 2, None] * rotation[2]
        return axes, map_points(links, self.center)

    def _near(self, frames: Frames, below: float) -> tuple[Placed, Float[Tensor, "p n"], Chosen]:
        """Return the placed shapes, the separations [m] of all bounding spheres, and the pairs
        nearer than `below` [m].
        """
        if not torch.compiler.is_compiling() and not is_known(frames):
            raise BadArgument(
                "frames", "a tensor inside torch.vmap", "a plain batch; `clearance` takes both"
            )
        shapes = self._place(frames)
        distance = self._distances(shapes[1])
        apart = distance - self._bounding_sums.to(distance)
        return shapes, apart, self._choose(apart < below)

    def _distances(self, center: Float[Tensor, "3 s n"]) -> Float[Tensor, "p n"]:
        """Return the distance [m] between the centres of the two shapes of each pair."""
        first, second = self.pairs.unbind(1)
        return _length(center.index_select(1, second) - center.index_select(1, first))

    @cached_property
    def _links(self) -> int:
        """Number of link frames that are needed to have every link with a collision shape."""
        return int(self.link.max()) + 1 if len(self.link) else 0

    @kept
    def _bounding(self) -> Float[Tensor, " s"]:
        """Radius (s,) [m] of the bounding sphere of each collision shape."""
        return torch.linalg.vector_norm(self.half, dim=1) + self.radius

    @kept
    def _bounding_sums(self) -> Float[Tensor, "p 1"]:
        """Sum of the radii [m] of the bounding spheres of each pair of shapes."""
        return self._bounding[self.pairs].sum(1, keepdim=True)

    def _choose(self, near: Bool[Tensor, "p n"]) -> Chosen:
        """Return the pairs and postures that the mask `near` marks."""
        counts = torch.stack([part.sum() for part in near.split(self.kinds)])
        ends = counts.cumsum(0).tolist()  # the only wait
        pair, row = torch.nonzero_static(near, size=ends[-1]).unbind(1)
        slices = [slice(low, high) for low, high in itertools.pairwise((0, *ends))]
        parts = [(kind, at) for kind, at in enumerate(slices) if at.stop > at.start]
        return Chosen(pair, row, parts)

    def _separations(self, shapes: Placed, chosen: Chosen) -> Float[Tensor, " k"]:
        """Return the separations [m] of chosen pairs of shapes."""
        pair, row, parts = chosen
        found = [self._of_kind(kind, shapes, pair[at], row[at])[0] for kind, at in parts]
        return torch.cat(found) if found else shapes[1].new_zeros(0)

    def _of_kind(
        self, kind: int, shapes: Placed, pair: Int[Tensor, " k"], row: Int[Tensor, " k"]
    ) -> tuple[Float[Tensor, " k"], Push]:
        """Return the separations [m] of pairs of one `kind`, and a function that returns separating
        directions.
        """
        (first, second), (one, two), place, gap = self._meet(shapes, pair, row)
        half, radius, bounding = (x.to(gap) for x in (self.half.T, self.radius, self._bounding))
        if kind == 1:

            def from_box(at: Int[Tensor, " c"]) -> Pushed:
                axes = two[:, :, at]
                local = _inside(axes, gap[:, at])
                out = local.abs() - half[:, second[at]]
                # inside the box, the nearest face counts
                nearest = row_numbers(out)[:, None] == out.argmax(0)
                slope = torch.where((out > 0).any(0), out.clamp_min(0), nearest.to(out))
                slope = torch.where(local < 0, -slope, slope)
                # any turn about the sphere's centre is free
                return (axes * _unit(slope)).sum(1), place[:, at] - gap[:, at]

            outside = box_distance(_inside(two, gap).T, half[:, second].T)
            return outside - radius[first], from_box
        apart = _length(gap) - bounding[first] - bounding[second]
        if kind == 2:
            return apart, lambda at: (_unit(gap[:, at]), place[:, at])
        boxes = BoxPairs(one, two, gap, half[:, first], half[:, second])
        along = boxes.along_axes()
        separation = along.amax(0)

        def between_boxes(at: Int[Tensor, " c"]) -> Pushed:
            some = BoxPairs(*(x[..., at] for x in boxes))
            push, arm = some.push(along[:, at].argmax(0))
            far = apart[at] > separation[at]
            push = torch.where(far, _unit(gap[:, at]), push)
            return push, place[:, at] + torch.where(far, 0.0, arm)

        return torch.maximum(apart, separation), between_boxes

    def _meet(
        self, shapes: Placed, pair: Int[Tensor, " k"], row: Int[Tensor, " k"]
    ) -> tuple[
        tuple[Tensor, Tensor], tuple[Tensor, Tensor], Float[Tensor, "3 k"], Float[Tensor, "3 k"]
    ]:
        """Return numbers of chosen pairs. They are two shape indices, two axes, the centre [m] of
        the second shape, and the vector between the centres [m].
        """
        rotation = shapes[0].flatten(2)
        center = shapes[1].flatten(1)
        n = shapes[1].shape[2]
        first, second = self.pairs[pair].unbind(1)
        one = first * n + row
        two = second * n + row
        place = center.index_select(1, two)
        gap = place - center.index_select(1, one)
        axes = rotation.index_select(2, one), rotation.index_select(2, two)
        return (first, second), axes, place, gap


def _inside(axes: Float[Tensor, "3 3 k"], v: Float[Tensor, "3 k"]) -> Float[Tensor, "3 k"]:
    """Return the components of vectors along the unit vectors in the columns of `axes`."""
    return (axes * v[:, None]).sum(0)


def _length(v: Float[Tensor, "3 *b"]) -> Float[Tensor, "*b"]:
    """Return the lengths of vectors; the derivative of the length of a zero vector is 0."""
    x, y, z = v
    squared = torch.addcmul(torch.addcmul(x * x, y, y), z, z)
    return torch.sqrt(squared.clamp_min(LEAST_SQUARE))


def _unit(v: Float[Tensor, "3 *b"]) -> Float[Tensor, "3 *b"]:
    """Return unit vectors in the directions of vectors; zero vectors stay zero."""
    return v / _length(v)


class BoxPairs(NamedTuple):
    """k pairs of boxes whose separations are computed; box a is the first of a pair, box b the
    second.

    All vectors of a pair are in one frame.
    """

    a: Float[Tensor, "3 3 k"]  # unit axes of box a, the columns of `a[:, :, k]`
    b: Float[Tensor, "3 3 k"]  # unit axes of box b, the columns of `b[:, :, k]`
    gap: Float[Tensor, "3 k"]  # vector [m] from the centre of box a to that of box b
    half_a: Float[Tensor, "3 k"]  # half sizes [m] of box a along its axes
    half_b: Float[Tensor, "3 k"]  # half sizes [m] of box b along its axes

    def along_axes(self) -> Float[Tensor, "15 k"]:
        """Return the separations (15, k) [m] of each pair of boxes along 15 candidate axes.

        One of these axes separates the boxes if any does (Gottschalk et al., 1996). The three axes
        of box a come first, then those of b, then the nine cross products. The largest separation
        of a pair is a lower bound of the distance. If it is negative, it is minus the shortest
        translation that separates the boxes.
        """
        a, b, gap, half_a, half_b = self
        rotation = (a[:, :, None] * b[:, None]).sum(0)  # b's axes in the frame of a
        t = _inside(a, gap)
        u = _inside(b, gap)
        size = rotation.abs()
        by_a = t.abs() - half_a - (size * half_b).sum(1)
        by_b = u.abs() - half_b - (size * half_a[:, None]).sum(0)
        # axis i of a cross axis j of b; the other two axes of a box follow by rolling
        along = torch.linalg.cross(rotation, t[:, None], dim=0)
        next_a, last_a = (half_a.roll(k, 0)[:, None] for k in (-1, 1))
        reach = next_a * size.roll(1, 0) + last_a * size.roll(-1, 0)
        reach = reach + half_b.roll(-1, 0) * size.roll(1, 1)
        reach = reach + half_b.roll(1, 0) * size.roll(-1, 1)
        sine = 1 - rotation * rotation
        crossing = sine > PARALLEL_EDGES  # the normals of the faces cover parallel edges
        by_edges = (along.abs() - reach) * torch.rsqrt(torch.where(crossing, sine, 1.0))
        by_edges = torch.where(crossing, by_edges, -torch.inf).flatten(0, 1)  # (9, k)
        return torch.cat([by_a, by_b, by_edges])

    def push(self, best: Int[Tensor, " c"]) -> Pushed:
        """Return (directions, points) of c = k pairs, both (3, c): where box b is pushed out of box
        a, and where they touch.

        `best` (c,) is the index of one of the 15 axes of `along_axes` for each pair. The direction
        is the unit vector of this axis that points towards box b. The contact point [m] is relative
        to the centre of box b.
        """
        a, b, gap, half_a, half_b = self
        best = best[None]
        edges = best >= 6
        i = torch.where(edges, (best - 6) // 3, best.clamp_max(2))
        j = torch.where(edges, (best - 6) % 3, (best - 3).clamp(0, 2))
        along_a = a.gather(1, i.expand(3, 1, -1))[:, 0]
        along_b = b.gather(1, j.expand(3, 1, -1))[:, 0]
        crossed = torch.linalg.cross(along_a, along_b, dim=0)
        push = torch.where(edges, crossed, torch.where(best < 3, along_a, along_b))
        push = _unit(push)
        push = torch.where((push * gap).sum(0) < 0, -push, push)
        reach_a = _inside(a, push).sign() * half_a
        reach_b = _inside(b, push).sign() * half_b
        # anywhere along an edge
        reach_a = reach_a.scatter(0, i, torch.where(edges, 0.0, reach_a.gather(0, i)))
        reach_b = reach_b.scatter(0, j, torch.where(edges, 0.0, reach_b.gather(0, j)))
        of_a = (a * reach_a).sum(1)
        of_b = -(b * reach_b).sum(1)
        between = gap + of_b - of_a
        cosine = (along_a * along_b).sum(0)
        beyond = (between * along_b).sum(0) - cosine * (between * along_a).sum(0)
        touch = of_b - beyond / (1 - cosine * cosine) * along_b
        corner = torch.where(best < 3, of_b, of_a - gap)
        return push, torch.where(edges, touch, corner)


def box_distance(points: Float[Tensor, "*b 3"], half: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """Return the signed distance (*b,) [m] of each point from a box around the origin, negative
    inside.

    `points` (*b, 3) [m] are in the frames of their boxes. `half` (*b, 3) [m] holds the half sizes
    of each point's box along x, y and z.
    """
    ox, oy, oz = (points.abs() - half).unbind(-1)
    px = ox.clamp_min(0)
    py = oy.clamp_min(0)
    pz = oz.clamp_min(0)
    squared = px * px + py * py + pz * pz
    outside = squared > 0
    inside = torch.maximum(torch.maximum(ox, oy), oz)
    # the root's derivative is infinite at 0; there the largest coordinate is the distance
    root = torch.sqrt(torch.where(outside, squared, 1.0))
    return torch.where(outside, root, inside)
