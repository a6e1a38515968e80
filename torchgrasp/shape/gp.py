"""The shape as a Gaussian process over signed distance and normal, with an interface in metres,
Eqs. (1), (7)-(9).
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Annotated, Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.cloud.neighbours import draw_rows
from torchgrasp.cloud.registration import VIEWS, compare_with
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import check_tensor, checked
from torchgrasp.foundation.errors import BadArgument, CloudWarning
from torchgrasp.foundation.rules import (
    LEAST,
    SMALL,
    Pose,
    Positive,
    Range,
    Seed,
    check_moved,
    is_known,
)
from torchgrasp.foundation.told import warn_user
from torchgrasp.geometry.frames import apply
from torchgrasp.geometry.linalg import Points, cholesky, dot, norm, unit, unit_of_any
from torchgrasp.geometry.plane import move
from torchgrasp.shape.conditioning import append_observations
from torchgrasp.shape.estimate import (
    JointEstimate,
    Normalisation,
    Observations,
    ShapeDerivatives,
    check_observations,
    on_surface,
    surface_deviation,
)
from torchgrasp.shape.kernel import Queries
from torchgrasp.shape.posterior import Posterior, symmetric_root
from torchgrasp.values.planning import PointCloud, ShapeEstimate


@dataclasses.dataclass(frozen=True)
class DomainNumbers:
    """Bounds of the queries of a shape: its domain, and the points of one joint posterior."""

    reach: float = 1.25
    """Ratio of the domain's radius to that of the observations: far away nothing is known."""
    joint: int = 1000
    """Greatest number of points of one joint posterior: its memory grows with their square."""
    compared: int = 300
    """Greatest number of points at which errors of poses are compared with the shape's deviations.
    """
    touched: float = 1.0
    """Greatest distance of a touched point from the shape's surface, in standard deviations, at
    which the normals there are compared.
    """
    inward: float = -0.8
    """Mean cosine of given normals with those of the shape, below which they all point inward."""


DOMAIN = DomainNumbers()
MeanAndSpread = tuple[Float[Tensor, "q 4"], Float[Tensor, "q k k"]]
"""Mean and covariance of `estimate`, or with the first k rows and columns of the covariance alone."""


@dataclasses.dataclass(frozen=True)
class ShapeGP(Posterior, Normalisation):
    """An object's shape as a Gaussian process over its signed distance, Eq. (1) of the paper.

    `fit_shape` and `condition` return shapes. Signed distances are negative inside the object and
    positive outside. Points of `predict`, `contains`, `joint`, `sample`, `differentiate`, `update`
    and `widened` are in the cloud's frame [m]. Methods that take normalised points say so;
    `normalise` returns these. One normalised unit of length is `scale` [m].

    n counts observed points, and r observed numbers: n distances, and three for each observed
    normal.

    Attributes:
        x: observed points (n, 3), normalised, those with normals first.
        has_normal: mask (n,) of the points with observed normals.
        weights: (K + noise)^-1 y (r,) of the observed numbers y: distances, then normals by
            component.
        factor: lower Cholesky factor (r, r) of K + noise, the covariance of the observed numbers.
        order: index (r,) in `weights` of each row of `factor`; None if both have the same order.
        kernel: the `Kernel`, the covariance of the signed distances at two points.
        center: origin (3,) [m] of the normalised frame, in the cloud's frame.
        scale: length [m] of one normalised unit, about the object's radius.
        psi: the kernel's length psi, normalised.
        domain_radius: radius, normalised, of the domain: the ball around `center` in which the
            posterior is valid.
        std_factor: ratio of the surface's true deviations to the posterior's standard deviations,
            calibrated on known objects. `std_m` of `predict` includes this factor.
        cloud: the points [m] that the camera saw, after cleaning.
        kind: how the hidden side was completed:
            "ball", "revolution", "mirrored", "vessel": as that of a ball, a body of revolution, a
              mirror-symmetric body, or an open vessel.
            "guess": from the outline alone, or not at all.
            "cut off": the image border cuts the object off.
            "whole": there is no hidden side.

    Results are differentiable in the query points to any order, those of `sample` twice. At
    observed points they are twice differentiable, and normals of the thin plate kernel once.
    `update` refuses points that require a gradient.

    >>> from torchgrasp import fit_shape, load_object
    >>> view = load_object("jug").view
    >>> shape, points = fit_shape(view), view.points[:4]
    >>> bool(shape.contains(points).all()), shape.joint(points).covariance.shape
    (True, torch.Size([16, 16]))
    >>> shape.sample(points, n=10).shape
    torch.Size([10, 4, 4])
    """

    psi: float
    domain_radius: float
    std_factor: float
    cloud: PointCloud
    kind: str = dataclasses.field(default="guess", kw_only=True)

    @classmethod
    @checked(gradients=True)
    def of(
        cls,
        posterior: Posterior,
        frame: Normalisation,
        cloud: PointCloud,
        psi: Positive,
        std_factor: Positive = 1.0,
    ) -> "ShapeGP":
        """Return a shape made of a posterior that is already computed, its normalised frame and the
        seen points.

        Nothing is transformed or computed anew: `condition` computes a posterior from observations,
        and `fit_shape` from a cloud.

        The domain is the ball around the frame's centre in which the posterior is valid. Its radius
        is the smaller of two lengths. One is half the kernel's `diameter`. The other is 1.25
        (`DOMAIN.reach`) times the greatest distance of an observed point from the centre. The
        shape's `kind` is "guess": the hidden side is not known from a symmetry.

        Args:
            posterior: the posterior, such as another shape. Its observations and its kernel are
                taken: `x`, `has_normal`, `weights`, `factor`, `order` and `kernel`.
            frame: the normalised frame of the posterior's points.
            cloud: the seen points [m], in the frame of `frame.center`.
            psi: length of the posterior's kernel, normalised: one unit is `frame.scale` [m]. It
                does not change the kernel. Batches of shapes with thin plate kernels are evaluated
                with it.
            std_factor: ratio of the surface's true deviations to the posterior's standard
                deviations.

        Raises `BadArgument` for a `psi` or `std_factor` that is not positive.
        """
        away = norm(posterior.x.detach())
        reach = DOMAIN.reach * float(away.max())
        radius = min(posterior.kernel.diameter / 2.0, reach)
        fields = common_fields(posterior, Posterior) | common_fields(frame, Normalisation)
        return cls(**fields, psi=psi, domain_radius=radius, std_factor=std_factor, cloud=cloud)

    def to(self, *args: Any, **kwargs: Any) -> "ShapeGP":
        """Return the shape on another device, given as in `torch.Tensor.to`.

        The dtype stays float64, which the covariance requires, even if float32 is given. Raises
        `BadArgument` for a device that does not exist, or for any other dtype.
        """
        check_moved(*args, **kwargs)
        device = torch.empty(0, device=self.x.device).to(*args, **kwargs).device
        return super().to(device)

    @property
    def device(self) -> torch.device:
        """The device of the shape's tensors."""
        return self.x.device

    @property
    def walls(self) -> "tuple[ShapeGP, ...]":
        """The surfaces that enclose the object's material, each as a shape of its own.

        They are this shape alone, or for a `HollowShape` (outer, inner).
        """
        return (self,)

    @checked(gradients=True)
    def wall_at(self, x: Queries) -> Bool[Tensor, "q walls"]:
        """Return which surface of `walls` determines the signed distance at each of q normalised
        points `x` (q, 3).

        The result is a mask (q, walls) with one True in each row. This shape has one surface, so
        the mask is (q, 1) and all True. `HollowShape.wall_at` has two columns.
        """
        return torch.ones(len(x), 1, dtype=torch.bool, device=x.device)

    @checked(gradients=True)
    def contains(
        self,
        points: Float[Tensor, "*b 3"],
    ) -> Bool[Tensor, "*b"]:
        """Return a mask (*b,) of the points (*b, 3) [m], in the cloud's frame, that are in the
        domain.

        The domain is the ball in which the posterior is valid: `domain_radius` around `center`. b
        stands for any batch axes.
        """
        return norm(self.normalise(points)) <= self.domain_radius

    @checked(gradients=True)
    def predict(
        self,
        points: Float[Tensor, "*b 3"],
        *,
        covariance: bool = True,
    ) -> ShapeEstimate:
        """Return signed distance, normal and covariance at points (*b, 3) [m] in the cloud's frame,
        Eqs. (7)-(8) of the paper.

        Distance, variance and covariance are normalised: one unit is `scale` [m]. `std_m` is in
        metres. The estimate has the dtype of `points`, and is differentiable in the points. b
        stands for any batch axes.

        With `covariance=False` the estimate's `covariance` is None, and the rest is the same up to
        rounding. The call is then faster: it multiplies one row for each point instead of four.

        The domain is the ball in which the posterior is valid. Points outside it, up to twice
        `domain_radius` from `center`, get a guess. There the distance grows outward with slope 1,
        from the distance at the nearest point of the domain. Covariance and `std_m` are the
        prior's.

        Raises `BadArgument` for numbers that are not finite, and for points farther than twice
        `domain_radius` from `center`. Inside torch.vmap neither is checked.

        >>> from torchgrasp import fit_shape, load_object
        >>> shape = fit_shape(load_object("jug").view)
        >>> edge = shape.center + torch.tensor([shape.domain_radius * shape.scale, 0.0, 0.0])
        >>> shape.predict(edge + torch.tensor([0.01, 0.0, 0.0])).std_m > 0.1
        tensor(True)
        """
        evaluate = self.estimate if covariance else self._estimate_distance
        mean, spread = self._evaluate_anywhere(evaluate, self._queries(points, 2.0))
        variance = spread[:, 0, 0]
        std_m = self.std_factor * self.scale * surface_deviation(variance, mean[:, 1:])
        return ShapeEstimate(
            distance=_reshape(mean[:, 0], points),
            normal=_reshape(unit(mean[:, 1:]), points),
            variance=_reshape(variance, points),
            covariance=_reshape(spread, points) if covariance else None,
            std_m=_reshape(std_m, points),
        )

    @checked(gradients=True)
    def differentiate(self, points: Float[Tensor, "*b 3"]) -> ShapeDerivatives:
        """Return the derivatives of the results of `predict` with respect to the points (*b, 3)
        [m].

        The points are in the cloud's frame. The derivatives are per metre, with the dtype of
        `points`. b stands for any batch axes.

        Raises `BadArgument` for numbers that are not finite, and for points outside the domain. The
        domain is the ball in which the posterior is valid; outside, `predict` gives a guess.

        >>> from torchgrasp import fit_shape, load_object
        >>> view = load_object("jug").view
        >>> fit_shape(view).differentiate(view.points[:4]).normal.shape
        torch.Size([4, 3, 3])
        """
        jet = self.jet(self._queries(points))
        length = norm(jet.gradient)[:, None, None]
        normal = jet.gradient[:, :, None] / length
        steeper = normal.transpose(1, 2) @ jet.hessian  # the derivative of the slope
        along = normal @ steeper
        std = surface_deviation(jet.variance, jet.gradient)[:, None]
        relative = jet.variance_gradient / (2 * jet.variance[:, None])
        relative = relative - steeper[:, 0] / length[:, 0]
        return ShapeDerivatives(
            distance=_reshape(jet.gradient / self.scale, points),
            normal=_reshape((jet.hessian - along) / (length * self.scale), points),
            variance=_reshape(jet.variance_gradient / self.scale, points),
            std_m=_reshape(self.std_factor * std * relative, points),
        )

    @checked(gradients=True)
    def joint(self, points: Float[Tensor, "k 3"]) -> JointEstimate:
        """Return the joint posterior of signed distance and gradient at k points (k, 3) [m] in the
        cloud's frame.

        It has the covariances of different points, which `predict` leaves out. The result is
        normalised: one unit is `scale` [m]. It has the dtype of `points`.

        Raises `BadArgument` for numbers that are not finite, or more than 1000 points
        (`DOMAIN.joint`). It is also raised for points outside the domain, the ball in which the
        posterior is valid (`contains`).
        """
        x = self._queries(points)
        if len(x) > DOMAIN.joint:
            most = f"at most {DOMAIN.joint} points at once"
            raise BadArgument("points", f"{len(x)} points", most)
        return self.joint_at(x).to(points.dtype)

    @checked(gradients=True)
    def sample(
        self,
        points: Float[Tensor, "k 3"],
        n: Annotated[int, Range(0, 1_000_000)],
        seed: Seed = 0,
    ) -> Float[Tensor, "n k 4"]:
        """Return n random samples (n, k, 4) of distance and gradient (d, w) at k points (k, 3) [m].

        The points are in the cloud's frame. Each sample is drawn for all k points together, from
        the posterior of `joint`. Distances are normalised: one unit is `scale` [m]. The same `seed`
        gives the same samples.

        The result has the dtype of `points`. Samples of one seed are twice differentiable in the
        points. Where points coincide, the derivatives assume that these points move together.

        Raises `BadArgument` for numbers that are not finite, more than 1000 points
        (`DOMAIN.joint`), or points outside the domain. It is also raised for n outside 0 to
        1,000,000. Raises `IndefiniteCovariance` if the covariance of the points is not positive
        semidefinite.
        """
        joint = self.joint(points.double())
        prior = float(self.prior_block()[0, 0].detach())
        root = symmetric_root(joint.covariance, prior, "query points within the domain")
        generator = torch.Generator("cpu").manual_seed(seed)
        # the draws are the same for all that torch.vmap maps over
        with torch._C._DisableFuncTorch():
            size = (n, len(root))
            draws = torch.randn(size, dtype=torch.float64, device="cpu", generator=generator)
            draws = draws.to(self.device)
        return (joint.mean + (draws @ root).reshape(n, *joint.mean.shape)).to(points)

    @checked
    def update(
        self,
        points: Float[Tensor, "m 3"],
        normals: Float[Tensor, "m 3"] | None = None,
        *,
        noise: Annotated[float, Range(LEAST, SMALL)] = 0.001,
        normal_noise: Positive = 0.05,
    ) -> "ShapeGP":
        """Return the shape given m more surface points, such as a finger's touch or a second view.

        The result equals the posterior given the earlier and the new observations at once. Kernel,
        `cloud` and the domain, the ball in which the posterior is valid, do not change.

        20 or more points (`VIEWS.least`) count as a view, which is compared with `cloud` if `cloud`
        has normals. The view's pose is in error if noise does not explain its distance from
        `cloud`. `MendedInput` then warns. The standard deviation [m] of this pose error is included
        in those of the new points. It is also included in all that the shape predicts (`widened`).

        Args:
            points: surface points (m, 3) [m] in the cloud's frame.
            normals: outward normals (m, 3) of any length, or None if they are unknown.
            noise: standard deviation [m] of a point along the normal, up to 0.1.
            normal_noise: standard deviation of the components of a unit normal (no unit).

        Warns (`CloudWarning`) of normals that point into the shape, as those of fingertips do.

        Raises `BadArgument` for a wrong argument, a normal of length 0, or a point outside the
        domain. It is also raised for a view that is farther from `cloud` than about three times the
        noise.

        >>> ball = unit(torch.randn(400, 3, generator=torch.Generator().manual_seed(0)))
        >>> from torchgrasp import fit_shape
        >>> touch = torch.tensor([[0.0, 0.0, 0.045]])
        >>> touched = fit_shape(PointCloud(0.04 * ball, ball)).update(touch)
        >>> touched.predict(torch.tensor([0.0, 0.0, 0.045])).distance.abs() < 0.01
        tensor(True)
        """
        x = self._queries(points)
        direction = torch.zeros_like(x)
        if normals is not None:
            direction = unit_of_any(normals.to(x))
            check_tensor("normals", direction, (len(x), 3))  # a normal of length 0 has become NaN
            self._warn_of_inward(points, direction)
        error = 0.0
        if self.cloud.normals is not None and len(x) >= VIEWS.least:
            facing = self.predict(points).normal if normals is None else unit_of_any(normals)
            error = compare_with(self.cloud, PointCloud(points.double(), facing.double()))
        deviation = math.hypot(noise, error) / self.scale
        new = on_surface(x, direction, torch.full_like(x[:, 0], deviation), normal_noise)
        has_normal = new.has_normal & (normals is not None)
        shape = self.append(dataclasses.replace(new, has_normal=has_normal))
        return shape if error == 0 else shape.widened(points, torch.full_like(x[:, 0], error))

    def _warn_of_inward(self, points: Points, direction: Points) -> None:
        """Warn if the unit normals `direction` of touched points on the known surface point into
        the shape. A touch within it may be one of another wall.
        """
        known = self.predict(points.double(), covariance=False)
        near = (known.distance * self.scale).abs() < DOMAIN.touched * known.std_m
        cosine = dot(direction.to(known.normal), known.normal)[near]
        if len(cosine) and float(cosine.mean()) < DOMAIN.inward:
            advice = "give outward ones, or none; those of a fingertip point into the object"
            warn_user(CloudWarning, f"normals: they point into the shape: {advice}")

    @checked
    def widened(self, points: Points, error: Float[Tensor, "n"]) -> "ShapeGP":
        """Return the shape with greater standard deviations, which include the error of a view's
        pose.

        An error of the pose moves all points of a view together, so more points do not reduce it.
        `std_factor` is multiplied by the median of sqrt(std_m^2 + error^2) / std_m over the points.
        Of more than 300 points (`DOMAIN.compared`), 300 are drawn with a fixed seed.

        Args:
            points: the view's points (n, 3) [m] in the cloud's frame.
            error: standard deviation (n,) [m] of each point because of the uncertain pose.

        Raises `BadArgument` if one of these points is farther than twice `domain_radius` from
        `center`.
        """
        rows = draw_rows(len(points), DOMAIN.compared).to(points.device)
        std_m = self.predict(points[rows]).std_m
        wider = float((torch.hypot(std_m, error[rows].to(std_m)) / std_m).median())
        return self._scale_deviations(wider)

    def _scale_deviations(self, factor: float) -> "ShapeGP":
        """Return the shape with all standard deviations times a factor."""
        return dataclasses.replace(self, std_factor=factor * self.std_factor)

    @checked
    def append(self, new: Observations) -> "ShapeGP":
        """Return the shape given further observations in its normalised frame, in addition to all
        earlier ones. One normalised unit is `scale` [m].

        Kernel, `cloud` and the domain do not change. The domain is the ball in which the posterior
        is valid. `update` does the same for points [m].

        Raises `BadArgument` for an observed normal that is no unit vector: one of twice the length
        would stretch distances. Raises `IndefiniteCovariance` if the covariance of the observations
        is not positive definite. It may be so for observations far outside the domain.
        """
        # elsewhere a plan would wait for the device
        if new.x.device.type == "cpu":
            check_observations(new, "new")
        return dataclasses.replace(self, **common_fields(append_observations(self, new), Posterior))

    @checked
    def moved(self, b_from_a: Pose) -> "ShapeGP":
        """Return the shape in frame b, given the rigid transform `b_from_a` (4, 4) [m].

        Frame a is that of this shape's `cloud`; a point p of frame a is `b_from_a` p in frame b.

        Raises `BadArgument` for a transform that is not rigid.
        """
        rotation = b_from_a[:3, :3].to(self.x)
        n = len(self.x)

        def turn(rows: Float[Tensor, "rows c"]) -> Float[Tensor, "rows c"]:
            normals = rows[n:].reshape(3, self.n_oriented * rows.shape[1])
            return torch.cat([rows[:n], (rotation @ normals).reshape(rows[n:].shape)])

        back = slice(None) if self.order is None else torch.argsort(self.order)
        covariance = (self.factor @ self.factor.T)[back][:, back]
        covariance = turn(turn(covariance).T)
        return dataclasses.replace(
            self,
            x=self.x @ rotation.T,
            center=apply(b_from_a.to(self.center), self.center[None])[0],
            weights=turn(self.weights[:, None])[:, 0],
            factor=cholesky(covariance, "the covariance of the observations", self.kernel.remedy),
            order=None,
            cloud=move(self.cloud, b_from_a),
        )

    def _queries(
        self,
        points: Float[Tensor, "*b 3"],
        reach: float = 1.0,
    ) -> Queries:
        """Return query points [m] as normalised points (q, 3); raise `BadArgument` beyond `reach`
        radii of domain.
        """
        flat = points.reshape(-1, 3)
        radius = reach * self.domain_radius
        x = self.normalise(flat.double().to(self.device))
        away = norm(x.detach())
        outside = away > radius
        if is_known(outside) and bool(outside.any()):
            first = int(torch.nonzero(outside)[0])
            where = "outside the domain" if reach == 1.0 else "far outside the domain"
            count = int(outside.sum())
            found = f"{count} of {len(flat)} points {where}, the first {flat[first].tolist()} m"
            distance = f"{float(away[first]) * self.scale:.4g} m from the centre"
            allowed = f"points within {radius * self.scale:.4g} m of {self.center.tolist()} m"
            raise BadArgument("points", f"{found}, {distance}", allowed)
        return x

    def _estimate_distance(self, x: Queries) -> MeanAndSpread:
        """Return the results of `estimate` with the variance (q, 1, 1) of the distance alone."""
        distance, gradient = self.mean_and_gradient(x)
        mean = torch.cat([distance[:, None], gradient], 1)
        return mean, self.variance(x)[:, None, None]

    def _evaluate_anywhere(
        self,
        evaluate: Callable[[Queries], MeanAndSpread],
        x: Queries,
    ) -> MeanAndSpread:
        """Return the results of `evaluate`; outside the domain a growing distance with the prior's
        covariance.

        `evaluate` is `estimate`, or has the first rows and columns of its covariance alone. The
        gradient outside has length 1. A prior's variance is positive everywhere. Within the
        domain's diameter of the centre a ball of the domain's size holds both. In such a ball the
        kernel is a covariance.
        """
        length = norm(x.detach(), keepdim=True)
        outside = length > self.domain_radius
        if not (is_known(outside) and bool(outside.any())):
            return evaluate(x)
        # with finite derivatives at points inside, too
        outward = unit(torch.where(outside, x, 1.0))
        nearest = torch.where(outside, self.domain_radius * outward, x)
        mean, spread = evaluate(nearest)
        away = ((x - nearest) * outward).sum(-1, keepdim=True)
        slope = (mean[:, 1:] * outward).sum(-1, keepdim=True)
        across = self.domain_radius / (self.domain_radius + away) * (mean[:, 1:] - slope * outward)
        grown = torch.cat([mean[:, :1] + away, unit(outward + across)], 1)
        rows = spread.shape[-1]
        prior = self.prior_block()[:rows, :rows]
        spread = torch.where(outside[..., None], prior, spread)
        return torch.where(outside, grown, mean), spread


def _reshape(
    rows: Float[Tensor, "q *c"],
    points: Float[Tensor, "*b 3"],
) -> Tensor:
    """Return rows in the dtype, on the device and with the batch shape of the points."""
    return rows.to(points).reshape(points.shape[:-1] + rows.shape[1:])


def common_fields(
    value: Value,
    kind: type[Value],
) -> dict[str, Any]:
    """Return those fields of a value that the class `kind` has, too: contents by name."""
    names = [f.name for f in dataclasses.fields(kind)]  # pyright: ignore[reportArgumentType]
    return {name: getattr(value, name) for name in names}
