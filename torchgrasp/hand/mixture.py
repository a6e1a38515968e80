"""What a hand can reach, and with which joints: a Gaussian mixture over joints and codes (Eqs. 19-23)."""

import dataclasses
import functools
import math
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Value, check_tensor
from torchgrasp.errors import BadArgument, ModelFileError
from torchgrasp.files import load_tensors, save_tensors
from torchgrasp.hand.code import CODE_NAMES
from torchgrasp.hand.load import find_hand
from torchgrasp.linalg import cholesky
from torchgrasp.values import ContactCode

PAPER_REACH = 2.0
"""The paper's threshold on f_i of Eq. (21). f is half a squared Mahalanobis distance, so that "two standard
deviations" in six dimensions accept only 32 % of what a single component itself generates (chi-square_6 < 4)."""

DEFAULT_REACH = 8.405946915
"""Half the 99 % quantile of chi-square with six degrees of freedom: a component accepts 99 % of its own codes."""

ROWS = 8192
"""Rows evaluated in one pass, to bound memory at rows x components x dimensions."""


@dataclasses.dataclass(frozen=True)
class GraspMixture(Value):
    """The joint density of joints and codes of one hand, a Gaussian mixture (Eqs. 19-20).

    A dimension is a joint [rad], in the order of the hand, or one of L1 L2 L3 [m] N1 N2 N3, which come last. All
    evaluation is in float64.

    Args:
        weights: pi_i, positive, of sum 1.
        means: mu_i.
        covariances: Sigma_i, symmetric and positive definite.
        names: of the dimensions.
        regularisation: the variance that the fit added to every dimension of every component, relative to the
            variance of that dimension over all samples.
        meta: what it was fitted on: hand, its hash, samples, seed, and what the fit reported.

    Raises:
        BadArgument: shapes that do not agree, weights that are not positive or do not sum to 1, an indefinite or
            asymmetric covariance.
    """

    weights: Float[Tensor, "m"]
    means: Float[Tensor, "m d"]
    covariances: Float[Tensor, "m d d"]
    names: tuple[str, ...]
    regularisation: float = 0.0
    meta: dict[str, str] = dataclasses.field(default_factory=dict[str, str])

    def __post_init__(self) -> None:
        """Check everything once, where the value is made."""
        m, d = len(self.weights), len(self.names)
        check_tensor("weights", self.weights, (m,))
        check_tensor("means", self.means, (m, d))
        check_tensor("covariances", self.covariances, (m, d, d))
        if m < 1 or not bool((self.weights > 0).all()) or abs(float(self.weights.double().sum()) - 1) > 1e-6:
            found = f"{m} weights of least {self.weights.min() if m else None} and sum {float(self.weights.sum())}"
            raise BadArgument("weights", found, "at least one, all positive, of sum 1 within 1e-6")
        if self.names[-6:] != CODE_NAMES or d < 7:
            raise BadArgument("names", self.names, f"the joints' names, then {', '.join(CODE_NAMES)}")
        scale = self.covariances.diagonal(dim1=-2, dim2=-1).abs().sqrt()
        skewness = (self.covariances - self.covariances.transpose(-1, -2)).abs()
        if bool((skewness > 1e-6 * scale[:, :, None] * scale[:, None, :]).any()):
            raise BadArgument("covariances", "an asymmetric matrix", "symmetric positive definite matrices")
        _, info = torch.linalg.cholesky_ex(self.covariances.double())
        if bool((info != 0).any()):
            found = f"an indefinite matrix in component {int(info.nonzero()[0])}"
            raise BadArgument("covariances", found, "symmetric positive definite matrices")

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The names of the joints, in the order of the hand."""
        return self.names[:-6]

    @functools.cached_property
    def _full(self) -> "_Whitening":
        return _Whitening.of(self.means, self.covariances)

    @functools.cached_property
    def _marginal(self) -> "_Whitening":
        """The density of the code alone, Eq. (22)."""
        return _Whitening.of(self.means[:, -6:], self.covariances[:, -6:, -6:])

    @functools.cached_property
    def _regression(self) -> Float[Tensor, "m h 6"]:
        """Sigma_(Theta,q) Sigma_q^-1 of Eq. (23)."""
        whitening = self._marginal.whitening
        return self.covariances[:, :-6, -6:].double() @ whitening.transpose(-1, -2) @ whitening

    def log_prob(self, x: Float[Tensor, "*b d"]) -> Float[Tensor, "*b"]:
        """Return the log-density of rows (joints, L, N), Eq. (19).

        Raises:
            BadArgument: rows of another length than the mixture has dimensions.
        """
        if x.ndim < 1 or x.shape[-1] != len(self.names):
            raise BadArgument("x", f"shape {tuple(x.shape)}", f"rows of {len(self.names)} numbers")
        rows = x.reshape(-1, x.shape[-1]).double()
        log_weights = self.weights.double().log()
        parts = [torch.logsumexp(log_weights + self._full.log_densities(part), -1) for part in rows.split(ROWS)]
        return torch.cat(parts).reshape(x.shape[:-1]).to(x.dtype)

    def reach(self, code: ContactCode | Float[Tensor, "*b 6"]) -> Float[Tensor, "*b"]:
        """Return the least f_i of Eq. (21), by which a code is within the hand's reach or not.

        Args:
            code: a `ContactCode` (rows b, 6 permutations) or bare codes q. A code of NaN has a reach of NaN.

        Returns:
            Half the squared Mahalanobis distance from the nearest component; compare with `DEFAULT_REACH` or
            `PAPER_REACH`.

        Raises:
            BadArgument: codes of another length than 6.
        """
        q = _checked(code)
        rows = q.reshape(-1, 6).double()
        parts = [0.5 * self._marginal.squared(part).amin(-1) for part in rows.split(ROWS)]
        return torch.cat(parts).reshape(q.shape[:-1]).to(q.dtype)

    def joints(self, code: ContactCode | Float[Tensor, "*b 6"]) -> Float[Tensor, "*b h"]:
        """Return the expected joints [rad] given a code, Eq. (23); they may lie outside the hand's limits.

        Args:
            code: a `ContactCode` or bare codes q. A code of NaN has joints of NaN.

        Raises:
            BadArgument: codes of another length than 6.
        """
        q = _checked(code)
        rows = q.reshape(-1, 6).double()
        parts = []
        for part in rows.split(ROWS):
            responsibility = self._log_responsibility(part).exp()
            parts.append((responsibility[..., None] * self._conditional_means(part)).sum(-2))
        return torch.cat(parts).reshape(*q.shape[:-1], len(self.joint_names)).to(q.dtype)

    def modes(self, q: Float[Tensor, "*b 6"], k: int) -> tuple[Float[Tensor, "*b k h"], Float[Tensor, "*b k"]]:
        """Return the conditional means of the k components most responsible for a code, and their h_i of Eq. (23).

        Where several postures have the code, their mean (Eq. 23) may be none of them; these are.

        Args:
            q: codes.
            k: how many, at most the number of components.

        Raises:
            BadArgument: k outside [1, m], or codes of another length than 6.
        """
        q = _checked(q)
        if not 1 <= k <= len(self.weights):
            raise BadArgument("k", k, f"1 to {len(self.weights)} (the mixture's components)")
        joints, weights = [], []
        for part in q.reshape(-1, 6).double().split(ROWS):
            top = self._log_responsibility(part).topk(k, dim=-1)
            picked = top.indices[..., None].expand(-1, -1, self.means.shape[1] - 6)
            joints.append(self._conditional_means(part).gather(-2, picked))
            weights.append(top.values.exp())
        shape = (*q.shape[:-1], k)
        found = torch.cat(joints).reshape(*shape, len(self.joint_names))
        return found.to(q.dtype), torch.cat(weights).reshape(shape).to(q.dtype)

    def loosened(self, lengths: float, cosines: float) -> "GraspMixture":
        """Return the mixture of codes observed with independent Gaussian noise: its variances are added to Sigma_q.

        A round fingertip rolls: the code of what it can touch differs from that of its pad's middle by some
        millimetres and by the pad's cone. Where codes fill a thin manifold (the Barrett hand's four joints), Eq. (21)
        refuses almost every contact triple that the hand can take, unless this slack is granted.

        Args:
            lengths: standard deviation [m] of L1 L2 L3.
            cosines: standard deviation of N1 N2 N3.

        Raises:
            BadArgument: a negative number.
        """
        if not (lengths >= 0 and cosines >= 0):
            raise BadArgument("lengths, cosines", (lengths, cosines), "two numbers of at least 0")
        noise = torch.zeros(len(self.names)).to(self.covariances)
        noise[-6:-3], noise[-3:] = lengths**2, cosines**2
        return dataclasses.replace(self, covariances=self.covariances + torch.diag(noise))

    def _log_responsibility(self, q: Float[Tensor, "n 6"]) -> Float[Tensor, "n m"]:
        """Return log h_i of Eq. (23); in logarithms a code far from every component still has its nearest."""
        return torch.log_softmax(self.weights.double().log() + self._marginal.log_densities(q), dim=-1)

    def _conditional_means(self, q: Float[Tensor, "n 6"]) -> Float[Tensor, "n m h"]:
        """Return each component's mean of the joints given the code, the bracket of Eq. (23)."""
        difference = q[:, None] - self.means[:, -6:].double()
        return self.means[:, :-6].double() + torch.einsum("mhc,nmc->nmh", self._regression, difference)

    def save(self, path: Path | str) -> Path:
        """Write the mixture as safetensors, atomically; `load_mixture` reads it back.

        Raises:
            OutputError: the file cannot be written.
        """
        tensors = {"weights": self.weights, "means": self.means, "covariances": self.covariances}
        meta = {**self.meta, "names": " ".join(self.names), "regularisation": repr(self.regularisation)}
        return save_tensors(path, "mixture", tensors, meta)


def _checked(code: ContactCode | Tensor) -> Float[Tensor, "*b 6"]:
    """Return the codes q of an argument, refusing rows that are not six numbers."""
    q = code.q if isinstance(code, ContactCode) else code
    if q.ndim < 1 or q.shape[-1] != 6:
        raise BadArgument("code", f"shape {tuple(q.shape)}", "rows of 6 numbers, L and N")
    return q


@dataclasses.dataclass(frozen=True)
class _Whitening:
    """Gaussians of m components, ready to be evaluated: W with W^T W = Sigma^-1, and W mu."""

    whitening: Float[Tensor, "m d d"]
    whitened_means: Float[Tensor, "m d"]
    log_scale: Float[Tensor, "m"]

    @staticmethod
    def of(means: Float[Tensor, "m d"], covariances: Float[Tensor, "m d d"]) -> "_Whitening":
        factor = cholesky(covariances.double(), "a component's covariance", "fit with fewer components")
        eye = torch.eye(means.shape[1], dtype=torch.float64, device=means.device)
        whitening = torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False)
        log_scale = whitening.diagonal(dim1=-2, dim2=-1).log().sum(-1) - 0.5 * means.shape[1] * math.log(2 * math.pi)
        return _Whitening(whitening, (whitening @ means.double()[..., None])[..., 0], log_scale)

    def squared(self, x: Float[Tensor, "n d"]) -> Float[Tensor, "n m"]:
        """Return the squared Mahalanobis distance of every row from every component."""
        m, d = self.whitened_means.shape
        whitened = (x @ self.whitening.reshape(m * d, d).T).reshape(-1, m, d) - self.whitened_means
        return (whitened * whitened).sum(-1)

    def log_densities(self, x: Float[Tensor, "n d"]) -> Float[Tensor, "n m"]:
        return self.log_scale - 0.5 * self.squared(x)


def load_mixture(name_or_path: Path | str) -> GraspMixture:
    """Read the mixture of a hand by the hand's name or folder, or any mixture by the path of its .safetensors file.

    Raises:
        HandFileError: there is no such hand.
        ModelFileError: the file is missing or malformed, its weights do not sum to 1, a covariance is indefinite.

    >>> load_mixture("allegro").means.shape
    torch.Size([41, 18])
    """
    path = mixture_path(name_or_path)
    tensors, meta = load_tensors(path, "mixture", {"weights", "means", "covariances"})
    if any(t.dtype != torch.float64 for t in tensors.values()):
        raise ModelFileError("path", f"{path}: {[str(t.dtype) for t in tensors.values()]}", "float64 tensors")
    shapes = [tuple(tensors[name].shape) for name in ("weights", "means", "covariances")]
    if len(shapes[1]) != 2 or shapes[0] != shapes[1][:1] or shapes[2] != (*shapes[1], shapes[1][1]):
        raise ModelFileError("path", f"{path}: shapes {shapes}", "(m), (m, d) and (m, d, d)")
    try:
        names, regularisation = tuple(meta.pop("names").split()), float(meta.pop("regularisation"))
        rest = {k: v for k, v in meta.items() if k not in ("kind", "version")}
        return GraspMixture(**tensors, names=names, regularisation=regularisation, meta=rest)
    except (KeyError, AttributeError, ValueError) as error:
        raise ModelFileError("path", f"{path}: {error}", "a mixture that GraspMixture.save wrote") from error


def mixture_path(name_or_path: Path | str) -> Path:
    """Return the file of a hand's mixture: a .safetensors path as it is, else mixture.safetensors in a hand's folder.

    Raises:
        HandFileError: neither such a path nor a hand.
    """
    if Path(name_or_path).suffix == ".safetensors":
        return Path(name_or_path)
    return find_hand(name_or_path) / "mixture.safetensors"
