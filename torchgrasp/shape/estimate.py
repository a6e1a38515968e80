"""Value classes of a shape: its normalised frame, its observations and its estimates.

Normalised lengths are in units of a frame's `scale` [m]. A jet is a value at a point with its
derivatives there.
"""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.base import Batch, Value
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Positive, is_known
from torchgrasp.geometry.linalg import Points, norm, unit
from torchgrasp.shape.kernel import Queries

MeanAndGradient = tuple[Float[Tensor, "q"], Queries]
"""The mean signed distance (q,) at each query point, normalised, and its gradient (q, 3)."""
LENGTHS = (0.5, 2.0)
"""Least and greatest length of an observed unit normal that is taken."""
Moments = tuple[Float[Tensor, "q 4"], Float[Tensor, "q 4 4"]]
"""Mean (q, 4) and covariance (q, 4, 4) of distance and gradient (d, w) at each query point,
normalised.
"""


@checked
@dataclasses.dataclass(frozen=True)
class Normalisation(Value):
    """A frame for normalised points, which have no unit: x = (point - `center`) / `scale`.

    `ShapeGP` is such a frame. One normalised unit of length is `scale` [m].

    Args:
        center: origin (3,) [m] of the normalised frame, in the cloud's frame.
        scale: length [m] of one normalised unit, above 0.

    Raises `BadArgument` for another scale.

    >>> frame = Normalisation(torch.tensor([0.0, 0.0, 0.1]), scale=0.05)
    >>> frame.normalise(torch.tensor([0.0, 0.0, 0.15])), frame.metres(torch.tensor([0.0, 0.0, 1.0]))
    (tensor([0.0000, 0.0000, 1.0000]), tensor([0.0000, 0.0000, 0.1500]))
    """

    center: Float[Tensor, "3"]
    scale: Positive

    @checked(gradients=True)
    def normalise(
        self,
        points: Float[Tensor, "*b 3"],
    ) -> Float[Tensor, "*b 3"]:
        """Return points (*b, 3) [m] of the cloud's frame as normalised points (*b, 3).

        Those are (points - `center`) / `scale`. b stands for any batch axes.
        """
        return (points - self.center.to(points)) / self.scale

    @checked(gradients=True)
    def metres(
        self,
        x: Float[Tensor, "*b 3"],
    ) -> Float[Tensor, "*b 3"]:
        """Return normalised points `x` (*b, 3) as points (*b, 3) [m] in the cloud's frame.

        The inverse of `normalise`. b stands for any batch axes.
        """
        return x * self.scale + self.center.to(x)


@checked
@dataclasses.dataclass(frozen=True)
class Observations(Batch):
    """Observed signed distances at n points, and observed normals at some of them, for `condition`.

    All lengths are normalised: one unit is `Normalisation.scale` [m].

    Args:
        x: observed points (n, 3), normalised.
        distance: signed distance (n,) of each point from the surface, normalised, positive outside.
        normal: outward unit normals (n, 3); any finite numbers where `has_normal` is False.
        has_normal: mask (n,) of the points whose normals are observed.
        distance_noise: standard deviation (n,) of each distance, normalised.
        normal_noise: standard deviation (n,) of each component of a unit normal (no unit); any
            finite numbers where `has_normal` is False.

    Raises `BadArgument` for tensors of shapes that do not fit together.

    >>> x, some = torch.eye(3), torch.ones(3)
    >>> len(Observations(x, 0 * some, x, some > 0, 0.01 * some, 0.05 * some).rows()[0])
    12
    """

    x: Points
    distance: Float[Tensor, "n"]
    normal: Points
    has_normal: Bool[Tensor, "n"]
    distance_noise: Float[Tensor, "n"]
    normal_noise: Float[Tensor, "n"]

    def rows(self) -> tuple[Float[Tensor, "rows"], Float[Tensor, "rows"]]:
        """Return (values, variances): all r observed numbers (r,), and the variances (r,) of their
        noise.

        Here r is n plus three for each observed normal. The n distances come first, normalised: one
        unit is `Normalisation.scale` [m]. Then come the observed normals by component: all x, all
        y, all z.
        """
        y = torch.cat([self.distance, self.normal[self.has_normal].T.reshape(-1)])
        noise = torch.cat([self.distance_noise, self.normal_noise[self.has_normal].repeat(3)])
        return y, noise * noise

    @property
    def least_noise(self) -> float:
        """The least standard deviation of the noise of all observed numbers.

        It is the least of `distance_noise`, and of `normal_noise` at the observed normals. A
        distance is normalised: one unit is `Normalisation.scale` [m]. A component of a normal has
        no unit.
        """
        every = torch.cat([self.distance_noise, self.normal_noise[self.has_normal]])
        return float(every.detach().min())

    def with_normals_first(self) -> "Observations":
        """Return the same observations in another order: those with normals come first.

        This is the order of the points in a `ShapeGP`. Among points with normals, and among the
        others, the order is kept.
        """
        return self[torch.argsort(~self.has_normal, stable=True)]


def check_observations(observations: Observations, name: str = "observations") -> None:
    """Raise `BadArgument` if the length of an observed normal is not near 1, or a standard
    deviation of the noise is negative. The error calls the observations `name`.

    Lengths from 0.5 to 2 (`LENGTHS`) are taken, as an optimiser changes them a little. Normals
    of other lengths, such as those weighted by the areas of a mesh's faces, would stretch all
    distances.
    """
    observed = observations.has_normal
    noises = {"distance_noise": observations.distance_noise}
    if is_known(observed):
        noises["normal_noise"] = observations.normal_noise[observed]
    for field, noise in noises.items():
        if is_known(noise) and bool((noise.detach() < 0).any()):
            found = f"a standard deviation of {float(noise.detach().min()):.4g}"
            raise BadArgument(f"{name}.{field}", found, "at least 0")
    if not (is_known(observations.normal) and is_known(observed)):
        return
    length = norm(observations.normal.detach()[observed])
    wrong = length[(length < LENGTHS[0]) | (length > LENGTHS[1])]
    if len(wrong):
        found = f"a vector of length {float(wrong[0]):.4g}"
        raise BadArgument(f"{name}.normal", found, "unit vectors")


def on_surface(
    x: Points,
    normals: Points,
    noise: Float[Tensor, "n"],
    normal_noise: float,
) -> Observations:
    """Return observations of n normalised points on the surface (distance 0) with outward unit
    normals.

    `noise` (n,) is the standard deviation of each distance, normalised. `normal_noise` is that of a
    normal's components.
    """
    yes = torch.ones(len(x), dtype=torch.bool, device=x.device)
    return Observations(
        x, torch.zeros_like(noise), normals, yes, noise, torch.full_like(noise, normal_noise)
    )


def off_surface(
    x: Points,
    distance: Float[Tensor, "n"],
    noise: float,
) -> Observations:
    """Return observations of signed distances at n points off the surface, without normals.

    Points, distances and `noise`, the standard deviation of a distance, are normalised.
    """
    no = torch.zeros(len(x), dtype=torch.bool, device=x.device)
    sigma = torch.full_like(distance, noise)
    return Observations(x, distance, torch.zeros_like(x), no, sigma, sigma)


@dataclasses.dataclass(frozen=True)
class MeanJet(Batch):
    """The mean signed distance at points with its gradient and Hessian, from `ShapeGP.mean_jet`.

    All lengths are normalised: one unit is `ShapeGP.scale` [m]. Derivatives are with respect to
    normalised coordinates. Gradients need not have unit length. b stands for the batch axes of the
    points.

    Attributes:
        distance: mean signed distance (*b,), normalised.
        gradient: gradient (*b, 3) of the mean (no unit).
        hessian: second derivatives (*b, 3, 3) of the mean [1 / normalised unit].
    """

    distance: Float[Tensor, "*b"]
    gradient: Float[Tensor, "*b 3"]
    hessian: Float[Tensor, "*b 3 3"]

    @property
    def normals(self) -> Float[Tensor, "*b 3"]:
        """The outward unit normals (*b, 3): the gradient divided by its length, Eq. (11) of the
        paper.
        """
        return unit(self.gradient)

    @property
    def normal_jacobian(self) -> Float[Tensor, "*b 3 3"]:
        """The Jacobian (*b, 3, 3) of the unit normals with respect to the points [1 / normalised
        unit].

        One normalised unit is `ShapeGP.scale` [m]. The Jacobian is (1 - n n^T) H / |g|, with the
        normal n, the Hessian H and the gradient g. Entry (i, j) is the derivative of normal_i with
        respect to point_j.
        """
        n = self.normals
        steep = norm(self.gradient)[..., None, None]
        along = n[..., :, None] * (n[..., None, :] @ self.hessian)
        return (self.hessian - along) / steep


@dataclasses.dataclass(frozen=True)
class SurfaceJet(MeanJet):
    """The mean signed distance with two derivatives, and its variance with one, from `ShapeGP.jet`.

    All lengths are normalised: one unit is `ShapeGP.scale` [m]. Derivatives are with respect to
    normalised coordinates. b stands for the batch axes of the points.

    Attributes:
        distance: mean signed distance (*b,), normalised.
        gradient: gradient (*b, 3) of the mean (no unit).
        hessian: second derivatives (*b, 3, 3) of the mean [1 / normalised unit].
        variance: variance (*b,) of the signed distance, in squared normalised units.
        variance_gradient: gradient (*b, 3) of the variance [normalised units].

    >>> from torchgrasp import fit_shape, load_object
    >>> shape = fit_shape(load_object("jug").view)
    >>> shape.jet(shape.x[:2]).hessian.shape
    torch.Size([2, 3, 3])
    """

    variance: Float[Tensor, "*b"]
    variance_gradient: Float[Tensor, "*b 3"]


@dataclasses.dataclass(frozen=True)
class JointEstimate(Value):
    """The joint posterior of signed distance d and gradient w at k points, from `ShapeGP.joint`.

    Distances are normalised: one unit is `ShapeGP.scale` [m]. The gradient w is with respect to
    normalised coordinates (no unit). It need not have unit length.

    Attributes:
        mean: means (k, 4) of (d, w) at each point.
        covariance: covariance (4 k, 4 k); its rows are (d, w) of point 0, of point 1, and so on.
            Points i and j have the block `covariance.reshape(k, 4, k, 4)[i, :, j]`.
    """

    mean: Float[Tensor, "k 4"]
    covariance: Float[Tensor, "rows rows"]


@dataclasses.dataclass(frozen=True)
class ShapeDerivatives(Value):
    """Derivatives of a `ShapeEstimate` with respect to the query points [m], from
    `ShapeGP.differentiate`.

    b stands for the batch axes of the query points. One normalised unit is `ShapeGP.scale` [m].

    Attributes:
        distance: derivatives (*b, 3) of the signed distance [normalised units / m].
        normal: derivatives (*b, 3, 3) of the unit normal [1/m]; `normal[..., i, j]` is d normal_i /
            d point_j.
        variance: derivatives (*b, 3) of the distance's variance [squared normalised units / m].
        std_m: derivatives (*b, 3) of the surface's standard deviation [m / m].
    """

    distance: Float[Tensor, "*b 3"]
    normal: Float[Tensor, "*b 3 3"]
    variance: Float[Tensor, "*b 3"]
    std_m: Float[Tensor, "*b 3"]


def surface_deviation(
    variance: Float[Tensor, "*b"],
    gradient: Float[Tensor, "*b 3"],
) -> Float[Tensor, "*b"]:
    """Return the standard deviation (*b,) of the surface along its normal, normalised.

    It is linearised: the root of the signed distance's `variance` (*b,), divided by the length of
    its `gradient` (*b, 3). b stands for any batch axes.
    """
    return variance.sqrt() / norm(gradient)
