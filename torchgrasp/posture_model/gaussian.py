"""A Gaussian mixture over named dimensions: density, samples, marginals and conditionals (Eqs.
19-20).

Each dimension has its own unit, which is that of the data.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.base import Kept, Value, changes_in_place, kept
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Range, Seed, check_dense, is_known
from torchgrasp.geometry.linalg import cholesky, dot, eye_like, matvec

PARAMETERS = ("weights", "means", "covariances")
# points evaluated together: bounds the memory of points x components x dimensions
ROWS_PER_CHUNK = 8192
ROUNDING = 1e-6  # greatest error of the weights' sum, and relative asymmetry of a covariance


class of_parameters(kept[Kept]):
    """A decorator of methods of a mixture: it makes a property whose value is cached, unless a
    parameter requires a gradient.

    The parameters are `weights`, `means` and `covariances`. An optimiser may change one that
    requires a gradient, so the value is then computed each time. It is also computed anew after a
    parameter was changed in place, as by an average of an optimiser's steps.
    """

    def __get__(self, instance: Any, owner: Any = None) -> Any:
        """Return the value of the property, or the property itself if it is read of the class."""
        if instance is None:
            return self
        parameters = [getattr(instance, name) for name in PARAMETERS]
        if any(x.requires_grad for x in parameters):
            return self.func(instance)
        if not torch.compiler.is_compiling():
            changes = changes_in_place(*parameters)
            if vars(instance).setdefault(f"{self.attrname} after", changes) != changes:
                vars(instance).pop(self.attrname, None)
                vars(instance)[f"{self.attrname} after"] = changes
        found = vars(instance).get(self.attrname)
        return super().__get__(instance, owner) if found is None else found

    def __set__(self, instance: Any, value: Any) -> None:
        """Raise `AttributeError`. This method also makes Python call `__get__` for values that are
        kept.
        """
        raise AttributeError(self.attrname)


@checked
@dataclasses.dataclass(frozen=True)
class GaussianMixture(Value):
    """A mixture of m Gaussians over d named dimensions (Eqs. 19-20 of the paper), evaluated in
    float64.

    Densities are differentiable, to any order, in the points and in `weights`, `means` and
    `covariances`.

    Args:
        weights: probabilities (m,) of the components, of sum 1.
        means: means (m, d) of the components, each entry in the unit of its dimension.
        covariances: covariances (m, d, d) of the components, each entry in the product of the units
            of its two dimensions.
        names: names of the d dimensions.

    Raises `BadArgument` for inconsistent shapes, a repeated name, or a covariance that is not
    symmetric and positive definite. It is also raised for weights that are negative or do not sum
    to 1.

    >>> mixture = GaussianMixture(torch.ones(1), torch.zeros(1, 2), torch.eye(2)[None], ("a", "b"))
    >>> mixture.condition({"b": 3.0}).means
    tensor([[0.]], dtype=torch.float64)
    >>> mixture.log_prob(torch.zeros(2)), mixture.marginal(["b"]).names, mixture.sample(5).shape
    (tensor(-1.8379), ('b',), torch.Size([5, 2]))
    """

    weights: Float[Tensor, "m"]
    means: Float[Tensor, "m d"]
    covariances: Float[Tensor, "m d d"]
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        d = len(self.names)
        weights = self.weights.detach()
        covariances = self.covariances.detach()
        if self.means.shape[1] != d:
            found = f"{d} names of {self.means.shape[1]} dimensions"
            raise BadArgument("names", found, "one for each")
        if d < 1 or len(set(self.names)) < d:
            raise BadArgument("names", self.names, "at least one, each once")
        if is_known(weights) and not (
            bool((weights >= 0).all()) and abs(float(weights.double().sum()) - 1) <= ROUNDING
        ):
            found = "no weights"
            if len(weights):
                found = f"the least weight {weights.min()} and sum {float(weights.sum())}"
            raise BadArgument("weights", found, "at least one, none negative, of sum 1 within 1e-6")
        if not is_known(covariances):
            return
        scale = covariances.diagonal(dim1=-2, dim2=-1).abs().sqrt()
        skewness = (covariances - covariances.mT).abs()
        allowed = "symmetric positive definite matrices"
        if bool((skewness > ROUNDING * scale[:, :, None] * scale[:, None, :]).any()):
            raise BadArgument("covariances", "an asymmetric matrix", allowed)
        info = torch.linalg.cholesky_ex(covariances.double()).info
        if bool((info != 0).any()):
            found = f"an indefinite matrix in component {int(info.nonzero()[0])}"
            raise BadArgument("covariances", found, allowed)

    @checked(gradients=True)
    def log_prob(self, x: Float[Tensor, "*b d"]) -> Float[Tensor, "*b"]:
        """Return the log-density (*b,) [nats] of the mixture at each point, Eq. (19) of the paper.

        Args:
            x: points (*b, d), each coordinate in the unit of its dimension. b stands for any batch
                axes.

        Raises `BadArgument` for points that do not have d coordinates.
        """
        if x.ndim < 1 or x.shape[-1] != len(self.names):
            raise BadArgument("x", f"shape {tuple(x.shape)}", f"rows of {len(self.names)} numbers")
        return map_rows(lambda rows: torch.logsumexp(self.log_joint(rows), -1), x)

    @checked(gradients=True)
    def log_joint(self, x: Float[Tensor, "n d"]) -> Float[Tensor, "n m"]:
        """Return log(weight) + log N(x | mean, covariance) of each point and each component, (n, m)
        [nats].

        It is -inf for a component of weight 0. The log-sum-exp over the m components is `log_prob`.

        Args:
            x: n points (n, d), each coordinate in the unit of its dimension.
        """
        density = self.whitening.log_scale - 0.5 * self.whitening.squared(x.double())
        weights = self.weights.double()
        # a weight of 0, as of a softmax that underflows, adds nothing to a derivative
        positive = weights > 0
        logs = torch.where(positive, weights, 1.0).log()
        return torch.where(positive, logs, -torch.inf) + density

    @checked
    def sample(self, n: Annotated[int, Range(0, 10**8)], seed: Seed = 0) -> Float[Tensor, "n d"]:
        """Draw n random points (n, d) of the mixture in float64, each coordinate in the unit of its
        dimension.

        The same `seed` gives the same points. Samples are not differentiable.

        Raises `BadArgument` for n or seed out of range, or a parameter that requires a gradient.
        """
        for name in PARAMETERS:
            check_dense(name, getattr(self, name), gradients=False)
        generator = torch.Generator().manual_seed(seed)
        weights = self.weights.double().cpu()
        means = self.means.double().cpu()
        draw = torch.rand(n, generator=generator, dtype=torch.float64, device="cpu")
        # By rounding the sum of the weights may lie below a draw, which then belongs to the last
        # component.
        component = torch.searchsorted(weights.cumsum(0), draw, right=True)
        component = component.clamp(max=len(weights) - 1)
        shape = (n, len(self.names))
        noise = torch.randn(shape, generator=generator, dtype=torch.float64, device="cpu")
        factor = torch.linalg.cholesky(self.covariances.double().cpu())
        rows = means[component]
        for k in range(len(weights)):
            rows[component == k] += noise[component == k] @ factor[k].T
        return rows.to(self.means.device)

    @checked(gradients=True)
    def marginal(self, names: Sequence[str]) -> "GaussianMixture":
        """Return the marginal mixture over the dimensions called `names`, in this order, Eq. (22)
        of the paper.

        The other dimensions are integrated out. Raises `BadArgument` for an unknown or repeated
        name.
        """
        index = self._index(names)
        block = self.covariances.double()[:, index][:, :, index]
        means = self.means.double()[:, index]
        return GaussianMixture(self.weights.double(), means, block, tuple(names))

    @checked(gradients=True)
    def condition(self, given: dict[str, float]) -> "GaussianMixture":
        """Return the mixture over the remaining dimensions, conditioned on values of the `given`
        ones, Eq. (23) of the paper.

        The remaining dimensions keep their order. Components whose weight becomes 0 are left out,
        except inside `torch.vmap`.

        Args:
            given: values of some dimensions, by name, in their units.

        Raises `BadArgument` for unknown names, values that are not finite, or if all dimensions are
        given.
        """
        observed = self._index(tuple(given))
        rest = [i for i in range(len(self.names)) if i not in observed]
        if not rest:
            raise BadArgument("given", "every dimension", "some of them")
        values = torch.tensor(list(given.values()), dtype=torch.float64, device=self.means.device)
        if not given:
            return self.marginal(self.names)
        part = self.marginal(tuple(given))
        weights = torch.softmax(part.log_joint(values[None])[0], 0)
        means = self.means.double()
        covariances = self.covariances.double()
        # whitened: (m, rest, observed)
        cross = covariances[:, rest][:, :, observed] @ part.whitening.matrix.mT
        offset = part.whitening.matrix @ (values - part.means)[..., None]
        means = means[:, rest] + (cross @ offset)[..., 0]
        covariances = covariances[:, rest][:, :, rest] - cross @ cross.mT
        covariances = (covariances + covariances.mT) / 2
        names = tuple(self.names[i] for i in rest)
        if is_known(weights):
            weights, means, covariances = (x[weights > 0] for x in (weights, means, covariances))
        return GaussianMixture(weights, means, covariances, names)

    def mean(self) -> Float[Tensor, "d"]:
        """Return the mean (d,) of the whole mixture, each entry in the unit of its dimension."""
        return self.weights.double() @ self.means.double()

    def covariance(self) -> Float[Tensor, "d d"]:
        """Return the covariance matrix (d, d) of the whole mixture.

        The unit of an entry is the product of the units of its two dimensions.
        """
        offset = self.means.double() - self.mean()
        within = torch.einsum("m,mij->ij", self.weights.double(), self.covariances.double())
        return within + torch.einsum("m,mi,mj->ij", self.weights.double(), offset, offset)

    @of_parameters
    def whitening(self) -> "Whitening":
        """The components in whitened form, which makes densities quick to evaluate.

        This property is cached unless a parameter requires a gradient. Its value has three fields:

        * `matrix` (m, d, d) holds the lower-triangular W of each component, with W^T W =
          covariance^-1.
        * `means` (m, d) holds W mean.
        * `log_scale` (m,) [nats] is the log-density of each Gaussian at its mean.
        """
        means = self.means.double()
        d = len(self.names)
        matrix = whitening_matrices(self.covariances.double())
        spread = matrix.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        log_scale = spread - 0.5 * d * math.log(2 * math.pi)
        return Whitening(matrix, matvec(matrix, means), log_scale)

    def _index(self, names: Sequence[str]) -> list[int]:
        unknown = [name for name in names if name not in self.names]
        if unknown or len(set(names)) < len(names):
            allowed = f"some of {', '.join(self.names)}, each once"
            raise BadArgument("names", unknown or tuple(names), allowed)
        return [self.names.index(name) for name in names]


@dataclasses.dataclass(frozen=True)
class Whitening:
    """The m Gaussians of a mixture in whitened form, without their weights.

    W (x - mean) of a Gaussian is standard normal if x is a sample of this Gaussian.
    """

    # lower-triangular matrix W of each Gaussian, with W^T W = covariance^-1
    matrix: Float[Tensor, "m d d"]
    means: Float[Tensor, "m d"]  # W times the mean of each Gaussian (no unit)
    log_scale: Float[Tensor, "m"]  # log-density [nats] of each Gaussian at its mean

    def squared(self, x: Float[Tensor, "n d"]) -> Float[Tensor, "n m"]:
        """Return the squared Mahalanobis distances (n, m), without unit, of n points from the means
        of the m Gaussians.

        The points `x` (n, d) are in the units of the mixture's dimensions.
        """
        m, d = self.means.shape
        whitened = (x @ self.matrix.reshape(m * d, d).T).reshape(-1, m, d) - self.means
        return dot(whitened, whitened)


def map_rows(
    function: Callable[[Float[Tensor, "n d"]], Tensor], x: Float[Tensor, "*b d"]
) -> Tensor:
    """Return the values of a function at all points `x` (*b, d), computed in float64 in chunks.

    `function` maps points (n, d) to a tensor whose first axis counts the points. In the result the
    batch axes of `x` replace this axis, and the dtype is that of `x`.
    """
    chunks = x.reshape(-1, x.shape[-1]).double().split(ROWS_PER_CHUNK)
    y = torch.cat([function(rows) for rows in chunks])
    return y.reshape(x.shape[:-1] + y.shape[1:]).to(x.dtype)


def whitening_matrices(covariances: Float[Tensor, "m d d"]) -> Float[Tensor, "m d d"]:
    """Return the lower-triangular matrix W of each of m covariances, with W^T W = covariance^-1.

    Raises `IndefiniteCovariance` if a covariance is not positive definite.
    """
    fix = "use fewer components or more samples"
    factor = cholesky(covariances, "a component's covariance", fix)
    eye = eye_like(factor.shape[-1], factor)
    return torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False)
