"""The shapes of many clouds in one value. Each entry of a batch of points belongs to the shape of
its own cloud.

Some stages work on batches of contacts or hands. They ask a shape for values at the points of each
entry. When entries drop out, they continue with the shape of those that are left (`rows`). A
`ShapeGP` is the one shape of all entries. A `ShapeBatch` stacks the observations of c clouds, and
knows the cloud of each entry.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import cached_property, partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.base import Value, at_once, flatnonzero, rank_in_group, spread
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.shape.estimate import MeanAndGradient, MeanJet, Moments, SurfaceJet
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.jets import (
    Weighted,
    distance_rows,
    evaluate_jet,
    evaluate_mean,
    evaluate_mean_jet,
)
from torchgrasp.shape.kernel import (
    CovarianceRows,
    Kernel,
    Queries,
    cross_covariance,
    differentiate_thin_plate,
    is_thin,
    separations,
    thin_plate,
)
from torchgrasp.shape.posterior import CHUNK

Evaluate = Callable[[Tensor, Tensor], tuple[Tensor, ...]]
"""A function of normalised points (q, 3) and the index (q,) of each point's surface.

It returns tensors whose first axis is q.
"""


@dataclasses.dataclass(frozen=True)
class Walls(Value):
    """The Gaussian process posteriors of w surfaces, stacked; all have thin plate kernels.

    Each surface has n observed points, the first `near` of them with normals. A surface with fewer
    is filled up with observations of weight 0.

    Args:
        x: observed points, normalised, those with normals first.
        a: weight of each observed distance (no unit).
        b: weight of each observed normal (no unit).
        whitener: the inverse L^-T of the transposed Cholesky factor L of the observations'
            covariance. The `rows` observed numbers are the distances, then the normals by
            component.
        psi: length of each kernel, normalised.
    """

    x: Float[Tensor, "w n 3"]
    a: Float[Tensor, "w n"]
    b: Float[Tensor, "w near 3"]
    whitener: Float[Tensor, "w rows rows"]
    psi: Float[Tensor, "w"]

    @classmethod
    def of(
        cls,
        shapes: Sequence[ShapeGP],
        device: torch.device,
    ) -> "Walls":
        """Return the posteriors of w shapes, each of one surface with a thin plate kernel, stacked.

        The result is on the `device`, where the Cholesky factors are inverted.
        """
        near = max(shape.n_oriented for shape in shapes)
        n = near + max(len(shape.x) - shape.n_oriented for shape in shapes)
        size = n + 3 * near
        x = shapes[0].x.new_zeros(len(shapes), n, 3)
        a = x.new_zeros(len(shapes), n)
        b = x.new_zeros(len(shapes), near, 3)
        psi = x.new_tensor([shape.psi for shape in shapes])
        counts = x.new_tensor([len(shape.factor) for shape in shapes])
        factor = torch.eye(size, dtype=x.dtype, device=device).repeat(len(shapes), 1, 1)
        place_of = torch.zeros(len(shapes), size, dtype=torch.long, device=x.device)
        for w, shape in enumerate(shapes):
            oriented = torch.arange(shape.n_oriented, device=x.device)
            others = torch.arange(len(shape.x) - len(oriented), device=x.device)
            place = torch.cat([oriented, near + others])
            rows = torch.cat([place, *(n + k * near + oriented for k in range(3))])
            own = shape.weighted
            x[w, place] = own.x
            a[w, place] = own.a
            b[w, oriented] = own.b
            factor[w, : len(rows), : len(rows)] = shape.factor.to(device)
            # rows of what is missing come last
            missing = torch.ones(size, dtype=torch.bool, device=x.device)
            missing = missing.index_fill(0, rows, False)
            place_of[w] = torch.cat([shape.ordered(rows), flatnonzero(missing)])
        x, a, b, psi, counts, place_of = (y.to(device) for y in (x, a, b, psi, counts, place_of))
        # no column for what is missing
        known = torch.arange(size, device=device) < counts[:, None]
        columns = torch.diag_embed(known.to(factor))
        inverse = torch.linalg.solve_triangular(factor.mT, columns, upper=True)
        place_of = place_of[..., None].expand_as(inverse)
        whitener = torch.empty_like(inverse).scatter_(1, place_of, inverse)
        return cls(x, a, b, whitener, psi)

    def weighted(self, wall: Int[Tensor, "q"]) -> Weighted:
        """Return what the posterior mean at each of q query points needs: observations and weights.

        Query point i belongs to the surface with the index `wall[i]`.
        """
        psi = self.psi[wall, None]
        fast = partial(differentiate_thin_plate, psi)
        kernel = Kernel(partial(thin_plate, psi=psi), closed_form=fast)
        return Weighted(self.x[wall], self.a[wall], self.b[wall], kernel)

    def whiten(
        self,
        wall: Int[Tensor, "q"],
        rows: CovarianceRows,
    ) -> CovarianceRows:
        """Return each line of `rows` (q, r) times the `whitener` L^-T of its surface.

        Line i belongs to the surface with the index `wall[i]`. It holds the covariances of one
        number with the r observed numbers of this surface. The dot product of two lines of the
        result is the covariance that the observations of one surface explain.
        """
        return self._together(wall, rows, lambda own, matrix: (own @ matrix,))[0]

    def explain(
        self,
        wall: Int[Tensor, "q"],
        rows: CovarianceRows,
    ) -> tuple[Float[Tensor, "q"], CovarianceRows]:
        """Return (explained, solved): k A k^T (q,) and k A (q, r) for each line k of `rows` (q, r).

        Line i holds the covariances k of one number with the r observed numbers of the surface
        `wall[i]`. A is the inverse covariance of these. k A k^T is the variance of the number that
        they explain.
        """

        def explain(own: Tensor, matrix: Tensor) -> tuple[Tensor, Tensor]:
            whitened = own @ matrix
            return torch.linalg.vecdot(whitened, whitened), whitened @ matrix.mT

        return self._together(wall, rows, explain)  # pyright: ignore[reportReturnType]

    def _together(
        self,
        wall: Int[Tensor, "q"],
        rows: CovarianceRows,
        function: Evaluate,
    ) -> tuple[Tensor, ...]:
        """Return a function of the rows of each surface, (w, m, rows), and the surfaces' whiteners,
        for all rows.
        """
        matrix = self.whitener
        group = wall
        if rows.device.type == "cpu":  # few surfaces have rows in a small chunk
            found, group = torch.unique(wall, return_inverse=True)
            matrix = matrix[found]
        slot = rank_in_group(group)
        most = int(torch.bincount(group, minlength=1).max())
        padded = rows.new_zeros(len(matrix), most, rows.shape[1])
        padded[group, slot] = rows
        return tuple(x[group, slot] for x in function(padded, matrix))


@dataclasses.dataclass(frozen=True)
class ShapeBatch(Value):
    """The shapes of c clouds, for a batch in which each entry belongs to one cloud.

    A batch has b entries (r in the annotation of `owner`). Points given to a method have the
    entries as axis 0. The points of entry i belong to the cloud with the index `owner[i]`. Methods
    of q points (q, 3) take equally many points of each entry, entry by entry. Numbers of a shape,
    such as its `scale`, are tensors with one number for each entry. Distances at normalised points
    are normalised, too.

    Args:
        surfaces: the posteriors of all surfaces: one for each cloud, then the inner ones of open
            vessels.
        wall: the indices (c, 2) of each cloud's outer and inner surface in `surfaces`. They are the
            same if the object is not hollow.
        centers: origin (c, 3) [m] of each cloud's normalised frame, in the frame of the cloud.
        scales: length [m] of one normalised unit of each cloud.
        radii: radius (c,) of each cloud's domain, the ball in which the shape is known, normalised.
        factors: each cloud's ratio of true deviations to the posterior's standard deviations.
        owner: index (b,) of the cloud of each entry.
        hollow: whether any object is hollow.
    """

    surfaces: Walls
    wall: Int[Tensor, "c 2"]
    centers: Float[Tensor, "c 3"]
    scales: Float[Tensor, "c"]
    radii: Float[Tensor, "c"]
    factors: Float[Tensor, "c"]
    owner: Int[Tensor, "r"]
    hollow: bool

    @classmethod
    def of(
        cls,
        shapes: Sequence[ShapeGP],
        device: torch.device | None = None,
    ) -> "ShapeBatch":
        """Return c shapes stacked to a batch of c entries, where entry i has shape i.

        `device` is by default that of the shapes. Raises `BadArgument` for a kernel that is no thin
        plate.
        """
        for shape in shapes:
            if not is_thin(shape.kernel):
                raise BadArgument("shapes", "a shape with another kernel", "thin-plate kernels")
        outer = [shape.walls[0] for shape in shapes]
        inner = [shape.walls[1] for shape in shapes if len(shape.walls) > 1]
        device = shapes[0].device if device is None else device
        own = torch.arange(len(shapes), device="cpu")
        second = torch.tensor([len(shape.walls) > 1 for shape in shapes], device="cpu")
        after = len(shapes) - 1 + second.cumsum(0)
        wall = torch.stack([own, torch.where(second, after, own)], 1)  # (c, 2)

        def number(name: str) -> Float[Tensor, "c"]:
            values = [getattr(shape, name) for shape in shapes]
            return torch.tensor(values, dtype=torch.float64, device=device)

        return cls(
            Walls.of([*outer, *inner], device),
            wall.to(device),
            torch.stack([shape.center for shape in shapes]).double().to(device),
            number("scale"),
            number("domain_radius"),
            number("std_factor"),
            own.to(device),
            bool(inner),
        )

    @property
    def device(self) -> torch.device:
        """The device of the shapes."""
        return self.centers.device

    @property
    def scale(self) -> Float[Tensor, "b"]:
        """The length (b,) [m] of one normalised unit, for each of b entries."""
        return self.scales[self.owner]

    @property
    def domain_radius(self) -> Float[Tensor, "b"]:
        """The normalised radius (b,) of the ball in which the shape is known, for each of b
        entries.
        """
        return self.radii[self.owner]

    @property
    def std_factor(self) -> Float[Tensor, "b"]:
        """The ratio (b,) of true deviations to the posterior's standard deviations, for each of b
        entries.
        """
        return self.factors[self.owner]

    @cached_property
    def walls(self) -> "tuple[ShapeBatch, ...]":
        """The batch as batches of shapes of one surface: the outer ones, then the inner ones.

        There are inner ones only if any object is hollow. The inner surface of an object that is
        not hollow is its outer one.
        """
        if not self.hollow:
            return (self,)
        sides = [self.wall[:, side, None].expand(-1, 2) for side in (0, 1)]
        return tuple(dataclasses.replace(self, wall=side, hollow=False) for side in sides)

    def rows(self, index: Int[Tensor, "k"]) -> "ShapeBatch":
        """Return a batch whose entry k has the shape of this batch's entry `index[k]`."""
        return dataclasses.replace(self, owner=self.owner[index])

    def normalise(
        self,
        points: Float[Tensor, "b *k 3"],
    ) -> Float[Tensor, "b *k 3"]:
        """Return the points (b, ..., 3) [m] of each of b entries in the normalised frame of its
        cloud.
        """
        center = spread(self.centers[self.owner].to(points), points, 1)
        return (points - center) / spread(self.scale.to(points), points)

    def metres(
        self,
        x: Float[Tensor, "b *k 3"],
    ) -> Float[Tensor, "b *k 3"]:
        """Return the normalised points (b, ..., 3) of each of b entries as points [m] in the frame
        of its cloud.
        """
        return x * spread(self.scale, x) + spread(self.centers[self.owner], x, 1)

    def wall_at(self, x: Queries) -> Bool[Tensor, "q walls"]:
        """Return which surface of `walls` determines the signed distance at each of q points `x`
        (q, 3).

        The result is a mask (q, walls) with one True in each row. The points are normalised,
        equally many for each entry, entry by entry.
        """
        if not self.hollow:
            return torch.ones(len(x), 1, dtype=torch.bool, device=x.device)
        own = self._surface_at(x) == self._wall(x)[:, 0]
        return torch.stack([own, ~own], 1)

    def mean_and_gradient(self, x: Queries) -> MeanAndGradient:
        """Return (distance, gradient): the mean signed distance (q,) and its gradient (q, 3).

        They are at q normalised points `x` (q, 3), equally many for each entry, entry by entry. The
        distance is normalised; the gradient has no unit.
        """

        def evaluate(part: Tensor, wall: Tensor) -> tuple[Tensor, ...]:
            return evaluate_mean(self.surfaces.weighted(wall), part, gradient=True)

        return self._evaluate(evaluate, x)  # pyright: ignore[reportReturnType]

    def mean_jet(self, x: Queries) -> MeanJet:
        """Return the mean signed distance with its first and second derivatives, at q points `x`
        (q, 3).

        The points and the results are normalised. The points are equally many for each entry, entry
        by entry.
        """

        def evaluate(part: Tensor, wall: Tensor) -> tuple[Tensor, ...]:
            return evaluate_mean_jet(self.surfaces.weighted(wall), part)[0]

        return MeanJet(*self._evaluate(evaluate, x))

    def variance(self, x: Queries) -> Float[Tensor, "q"]:
        """Return the variance (q,) of the signed distance at q normalised points `x` (q, 3).

        It is in squared normalised units, without `std_factor`. The points are equally many for
        each entry, entry by entry.
        """

        def evaluate(part: Tensor, wall: Tensor) -> tuple[Tensor]:
            of = self.surfaces.weighted(wall)
            d, r = separations(part, of.x)
            k, first = of.kernel.derivatives(r, 2)
            rows = distance_rows(d, k, first, of.b.shape[1])
            whitened = self.surfaces.whiten(wall, rows)
            prior = of.kernel.profile(part.new_zeros(len(part), 1))[:, 0]
            return (prior - torch.linalg.vecdot(whitened, whitened),)

        return self._evaluate(evaluate, x)[0]

    def jet(self, x: Queries) -> SurfaceJet:
        """Return mean and variance of the signed distance, with derivatives, at q points `x` (q,
        3).

        The points and the results are normalised. The mean has first and second derivatives, the
        variance the first. The points are equally many for each entry, entry by entry.
        """

        def evaluate(part: Tensor, wall: Tensor) -> tuple[Tensor, ...]:
            explain = partial(self.surfaces.explain, wall)
            return evaluate_jet(self.surfaces.weighted(wall), part, explain)

        return SurfaceJet(*self._evaluate(evaluate, x))

    def estimate(self, x: Queries) -> Moments:
        """Return (mean, covariance) of signed distance and gradient (d, w) at q points `x` (q, 3),
        Eqs. (7)-(8) of the paper.

        The mean is (q, 4) and the covariance (q, 4, 4). Points and results are normalised. The
        points are equally many for each entry, entry by entry.
        """

        def evaluate(part: Tensor, wall: Tensor) -> tuple[Tensor, Tensor]:
            of = self.surfaces.weighted(wall)
            zero = torch.zeros_like(part)
            rows = cross_covariance(of.kernel, part, of.x, of.b.shape[1]).transpose(0, 1)
            weights = torch.cat([of.a, of.b.mT.flatten(1)], 1)
            walls = wall.repeat_interleave(4)
            whitened = self.surfaces.whiten(walls, rows.flatten(0, 1)).view_as(rows)
            prior = cross_covariance(of.kernel, zero, zero[:, None], 1).transpose(0, 1)
            return (rows @ weights[..., None])[..., 0], prior - whitened @ whitened.mT

        return self._evaluate(evaluate, x)  # pyright: ignore[reportReturnType]

    def _wall(self, x: Queries) -> Int[Tensor, "q 2"]:
        """Return the outer and the inner surface of the cloud of each point."""
        return self.wall[self.owner].repeat_interleave(len(x) // max(len(self.owner), 1), 0)

    def _surface_at(self, x: Queries) -> Int[Tensor, "q"]:
        """Return the surface that applies at each point: of a hollow object the one with the
        greater mean distance.
        """
        outer, inner = self._wall(x).unbind(1)
        if not self.hollow:
            return outer

        def mean(part: Tensor, wall: Tensor) -> tuple[Tensor, ...]:
            return evaluate_mean(self.surfaces.weighted(wall), part, gradient=False)

        within = self._evaluate(mean, x, inner)[0] > self._evaluate(mean, x, outer)[0]
        return torch.where(within, inner, outer)

    def _evaluate(
        self,
        evaluate: Evaluate,
        x: Queries,
        wall: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """Return the results of a function of points and surfaces, for chunks of points, joined."""
        wall = self._surface_at(x) if wall is None else wall
        size = at_once(x, CHUNK.jet)
        parts = [evaluate(*part) for part in zip(x.split(size), wall.split(size), strict=True)]
        return tuple(map(torch.cat, zip(*parts, strict=True)))
