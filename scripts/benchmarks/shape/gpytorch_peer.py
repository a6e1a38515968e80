"""What the shape is measured against: GPyTorch with derivatives, a selection that refits, a bare matrix product."""

from collections.abc import Callable

import torch
from torch import Tensor

from torchgrasp.shape.values import Observations


def gpytorch_posterior(x: Tensor, y: Tensor, noise: float, dense: bool) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    """Return a function of queries that gives mean and variance of value and gradient by GPyTorch's RBFKernelGrad.

    Everything that does not depend on the queries is cached: the first call, which fills the caches, belongs to the
    fit and is made here.

    Args:
        x: (n, 3) observed points.
        y: (n, 4) value and gradient.
        noise: standard deviation of all of them.
        dense: whether it factors matrices of any size; by itself it does so up to 800 rows, and takes conjugate
            gradients beyond.
    """
    import gpytorch

    class Model(gpytorch.models.ExactGP):
        """A Gaussian process on values and gradients."""

        def __init__(self) -> None:
            likelihood = gpytorch.likelihoods.MultitaskGaussianLikelihood(num_tasks=4, has_global_noise=False)
            super().__init__(x, y, likelihood)
            self.mean_module = gpytorch.means.ConstantMeanGrad()
            self.covar_module = gpytorch.kernels.RBFKernelGrad()

        def forward(self, x: Tensor) -> gpytorch.distributions.MultitaskMultivariateNormal:
            """Return the prior at points."""
            return gpytorch.distributions.MultitaskMultivariateNormal(self.mean_module(x), self.covar_module(x))

    model = Model().double()
    model.likelihood.task_noises = torch.full((4,), noise**2, dtype=torch.float64)
    model.covar_module.lengthscale = 0.5
    model.eval()

    def query(points: Tensor) -> tuple[Tensor, Tensor]:
        with torch.no_grad(), gpytorch.settings.max_cholesky_size(10**6 if dense else 800):
            found = model(points)
            return found.mean, found.variance

    query(x[:2])
    return query


def thin_plate_rows(x: Tensor, other: Tensor, psi: float, rows: bool, columns: bool) -> Tensor:
    """Return the covariance of values, with gradients where asked, by the closed form: no autograd, no masks.

    With d = x - x', r = |d|: k = 2 r^3 - 3 psi r^2 + psi^3, dk/dx = 6 (r - psi) d, and
    d2k/dx dx' = 6 (psi - r) I - 6 d d^T / r.
    """
    d = x[:, None] - other[None]
    r = torch.sqrt((d * d).sum(-1))
    slope = 6.0 * (r - psi)
    top = [r * r * (2.0 * r - 3.0 * psi) + psi**3]
    if columns:
        top += [-slope * d[..., n] for n in range(3)]
    blocks = [torch.cat(top, 1)]
    if rows:
        inverse = torch.where(r > 0, 6.0 / r, 0.0)
        for m in range(3):
            line = [slope * d[..., m]]
            if columns:
                line += [-inverse * d[..., m] * d[..., n] - (slope if m == n else 0.0) for n in range(3)]
            blocks.append(torch.cat(line, 1))
    return torch.cat(blocks)


def select_by_refitting(
    x: Tensor, known: Observations, budget: int, psi: float, distance_noise: float, normal_noise: float
) -> Tensor:
    """Return the picks of greatest posterior variance, the whole model being refitted for each of them."""
    picks: list[int] = []
    own = torch.tensor([distance_noise] + 3 * [normal_noise], dtype=x.dtype) ** 2
    for _ in range(budget):
        chosen = x[picks]
        cross = thin_plate_rows(known.x, chosen, psi, False, True)
        matrix = torch.cat(
            [
                torch.cat([thin_plate_rows(known.x, known.x, psi, False, False), cross], 1),
                torch.cat([cross.T, thin_plate_rows(chosen, chosen, psi, True, True)], 1),
            ]
        )
        noise = torch.cat([known.distance_noise**2, own.repeat_interleave(len(picks))])
        factor = torch.linalg.cholesky(matrix + torch.diag_embed(noise))
        columns = torch.cat(
            [thin_plate_rows(known.x, x, psi, False, False), thin_plate_rows(chosen, x, psi, True, False)]
        )
        whitened = torch.linalg.solve_triangular(factor, columns, upper=False)
        variance = psi**3 - (whitened * whitened).sum(0)
        variance[picks] = -torch.inf
        picks.append(int(variance.argmax()))
    return torch.tensor(picks)


def product_floor(rows: int, columns: int, chunk: int = 4096) -> Callable[[], None]:
    """Return an action: the dense product of a square matrix with as many columns as a triangular solve would have.

    The triangular matrix of a posterior needs half of it, which is the floor of any exact variance.
    """
    generator = torch.Generator().manual_seed(0)
    square = torch.randn(rows, rows, generator=generator, dtype=torch.float64)
    piece = torch.randn(rows, chunk, generator=generator, dtype=torch.float64)
    out = torch.empty_like(piece)

    def multiply() -> None:
        for _ in range(round(columns / chunk)):
            torch.mm(square, piece, out=out)

    return multiply
