"""The shapes of many clouds as one: each row of contacts or of hands belongs to the shape of its
own cloud.

Stages that work on rows ask a shape for values at the rows' points, and go on with the shape's
`rows`. A `ShapeGP` is the shape of all its rows. A `ShapeBatch` stacks the observations of c
clouds, and knows the cloud of each row.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import cached_property, partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.base import Value, at_once, rank_in_group, spread
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.shape.estimate import MeanAndGradient, MeanJet, Moments, SurfaceJet
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.jets import Weighted, evaluate_jet, evaluate_mean, evaluate_mean_jet
from torchgrasp.shape.kernel import (
    CovarianceRows,
    Kernel,
    Queries,
    cross_covariance,
    differentiate_thin_plate,
    thin_plate,
)
from torchgrasp.shape.posterior import CHUNK

Evaluate = Callable[[Tensor, Tensor], tuple[Tensor, ...]]
"""A function of points and the surface of each."""


@dataclasses.dataclass(frozen=True)
class Walls(Value):
    """The posteriors of w surfaces with thin-plate kernels; missing observations have the weight 0.

    Args:
        x: observed points, those with normals first.
        a: weight of each observed distance.
        b: weight of each observed normal, of the first `near` points.
        whitener: rows of covariances with all observations (distances, then normals by component),
            times this matrix, are white.
        psi: length of each kernel.
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
        """Stack the posteriors of shapes, each of one surface, on a device, which inverts the
        Cholesky factors.
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
            x[w, place], a[w, place], b[w, oriented], _ = shape.weighted
            factor[w, : len(rows), : len(rows)] = shape.factor.to(device)
            # rows of what is missing come last
            missing = torch.ones(size, dtype=torch.bool, device=x.device)
            missing = missing.index_fill(0, rows, False)
            place_of[w] = torch.cat([shape.ordered(rows), torch.nonzero(missing)[:, 0]])
        x, a, b, psi, counts, place_of = (y.to(device) for y in (x, a, b, psi, counts, place_of))
        # no column for what is missing
        known = torch.arange(size, device=device) < counts[:, None]
        columns = torch.diag_embed(known.to(factor))
        inverse = torch.linalg.solve_triangular(factor.mT, columns, upper=True)
        place_of = place_of[..., None].expand_as(inverse)
        whitener = torch.empty_like(inverse).scatter_(1, place_of, inverse)
        return cls(x, a, b, whitener, psi)

    def weighted(self, wall: Int[Tensor, "q"]) -> Weighted:
        """Return the observations and weights of the surface of each query point."""
        psi = self.psi[wall, None]
        fast = partial(differentiate_thin_plate, psi)
        kernel = Kernel(partial(thin_plate, psi=psi), closed_form=fast)
        return Weighted(self.x[wall], self.a[wall], self.b[wall], kernel)

    def whiten(
        self,
        wall: Int[Tensor, "q"],
        rows: CovarianceRows,
    ) -> CovarianceRows:
        """Return rows of covariances with the observations of each row's surface, whitened; see
        `Posterior.whiten`.
        """
        return self._together(wall, rows, lambda own, matrix: (own @ matrix,))[0]

    def explain(
        self,
        wall: Int[Tensor, "q"],
        rows: CovarianceRows,
    ) -> tuple[Float[Tensor, "q"], CovarianceRows]:
        """Return what the observations of each row's surface explain; see `Posterior.explain`."""

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
    """The shapes of c clouds: row r of all points that a method is given belongs to cloud
    `owner[r]`.

    Numbers of a shape, such as its `scale`, are tensors with one number for each row.

    Args:
        surfaces: the posteriors of all surfaces: one for each cloud, then the inner ones of open
            vessels.
        wall: the indices of each cloud's outer and inner surface, which are the same if the object
            is not hollow.
        centers, scales, radii, factors: center [m], scale [m], domain radius and factor of
            deviations of each cloud.
        owner: the cloud of each row.
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
        """Stack shapes, with one row for each, on a device, by default theirs; refuse another
        kernel by name.
        """
        for shape in shapes:
            form = shape.kernel.closed_form
            if not (isinstance(form, partial) and form.func is differentiate_thin_plate):
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
        """The length [m] of one normalised unit, of each row."""
        return self.scales[self.owner]

    @property
    def domain_radius(self) -> Float[Tensor, "b"]:
        """The radius, normalised, in which the shape is known, of each row."""
        return self.radii[self.owner]

    @property
    def std_factor(self) -> Float[Tensor, "b"]:
        """The factor of standard deviations, of each row."""
        return self.factors[self.owner]

    @cached_property
    def walls(self) -> "tuple[ShapeBatch, ...]":
        """The outer surfaces and, if any object is hollow, the inner ones, each as shapes of one
        surface.
        """
        if not self.hollow:
            return (self,)
        sides = [self.wall[:, side, None].expand(-1, 2) for side in (0, 1)]
        return tuple(dataclasses.replace(self, wall=side, hollow=False) for side in sides)

    def rows(self, index: Int[Tensor, "k"]) -> "ShapeBatch":
        """Return the shapes of some of the rows."""
        return dataclasses.replace(self, owner=self.owner[index])

    def normalise(
        self,
        points: Float[Tensor, "b *k 3"],
    ) -> Float[Tensor, "b *k 3"]:
        """Return points [m] of each row in the normalised frame of its cloud."""
        center = spread(self.centers[self.owner].to(points), points, 1)
        return (points - center) / spread(self.scale.to(points), points)

    def metres(
        self,
        x: Float[Tensor, "b *k 3"],
    ) -> Float[Tensor, "b *k 3"]:
        """Return normalised points of each row in metres."""
        return x * spread(self.scale, x) + spread(self.centers[self.owner], x, 1)

    def wall_at(self, x: Queries) -> Bool[Tensor, "q walls"]:
        """Return a mask (points, walls): which of the `walls` is the surface at each normalised
        point.
        """
        if not self.hollow:
            return torch.ones(len(x), 1, dtype=torch.bool, device=x.device)
        own = self._surface_at(x) == self._wall(x)[:, 0]
        return torch.stack([own, ~own], 1)

    def mean_and_gradient(self, x: Queries) -> MeanAndGradient:
        """Return the mean signed distance and its gradient at normalised points."""

        def evaluate(part: Tensor, wall: Tensor) -> tuple[Tensor, ...]:
            return evaluate_mean(self.surfaces.weighted(wall), part, gradient=True)

        return self._evaluate(evaluate, x)  # pyright: ignore[reportReturnType]

    def mean_jet(self, x: Queries) -> MeanJet:
        """Return the mean distance with first and second derivatives at normalised points."""

        def evaluate(part: Tensor, wall: Tensor) -> tuple[Tensor, ...]:
            return evaluate_mean_jet(self.surfaces.weighted(wall), part)[0]

        return MeanJet(*self._evaluate(evaluate, x))

    def jet(self, x: Queries) -> SurfaceJet:
        """Return mean and variance of the distance with their derivatives at normalised points."""

        def evaluate(part: Tensor, wall: Tensor) -> tuple[Tensor, ...]:
            explain = partial(self.surfaces.explain, wall)
            return evaluate_jet(self.surfaces.weighted(wall), part, explain)

        return SurfaceJet(*self._evaluate(evaluate, x))

    def estimate(self, x: Queries) -> Moments:
        """Return mean and covariance of distance and gradient at normalised points, Eqs. (7)-(8) of
        the paper.
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
