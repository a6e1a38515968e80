"""Quality of a learned model: errors on held-out postures (Sec. 6.3). Also the Bayesian information
criterion (BIC) by number of components (Fig. 6).
"""

import dataclasses
from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Count
from torchgrasp.geometry.frames import real
from torchgrasp.posture_model.em import EmRule, start_components
from torchgrasp.posture_model.mixture import DEFAULT_ENERGY, PAPER_ENERGY, GraspMixture
from torchgrasp.posture_model.sample import HandSamples
from torchgrasp.posture_model.stepwise import growing_fits
from torchgrasp.posture_model.training import (
    MAX_REGULARISATION,
    information_criterion,
    standardised_rows,
)

# likeliest modes of which the nearest to a posture is compared: a code has only a few postures
COMPARED_MODES = 4
GROWING = EmRule(iterations=100, tolerance=1e-3, regularisation=MAX_REGULARISATION)
"""The bounds that end each of the fits with one component more than the last."""


@dataclasses.dataclass(frozen=True)
class MixtureScore(Value):
    """The errors with which a learned posture model predicts the h joints of held-out postures,
    given their contact codes.

    Errors of sliding joints are in [m] in place of [rad]. The energy of a code tells whether the
    hand can reach such contacts; less is better.
    """

    joint_names: tuple[str, ...]  # names of the h joints
    # mean absolute error of each joint [rad], predicted by the conditional mean, Eq. (23)
    error: Float[Tensor, "h"]
    # standard deviation of the absolute error over the postures [rad]
    deviation: Float[Tensor, "h"]
    # mean absolute error [rad] of the best of the four (`COMPARED_MODES`) likeliest components
    nearest_mode: float
    paper_coverage: float  # share of the codes whose energy is below the paper's 2 (`PAPER_ENERGY`)
    default_coverage: float  # share of the codes whose energy is below 6.3 (`DEFAULT_ENERGY`)
    log_likelihood: float  # mean log-likelihood [nats] of the postures under the model
    postures: int  # number of held-out postures

    @property
    def mean_error(self) -> float:
        """The mean absolute error [rad] over all joints and postures."""
        return float(self.error.mean())

    def __str__(self) -> str:
        """Return a table of the errors (Table 5, Fig. 8) and the share of codes that the hand
        reaches (Eq. 21).
        """
        rows = zip(self.joint_names, self.error.tolist(), self.deviation.tolist(), strict=True)
        joints = "\n".join(
            f"  {name:20s} {error:.3f} +- {deviation:.3f}" for name, error, deviation in rows
        )
        return (
            f"mean absolute error on {self.postures} held-out postures [rad]: "
            "Eq. (23) +- deviation over postures\n"
            f"{joints}\n  {'all joints':20s} {self.mean_error:.3f}; "
            f"the nearest of {COMPARED_MODES} modes {self.nearest_mode:.3f}\n"
            f"within reach: {self.paper_coverage:.4f} at the paper's {PAPER_ENERGY:g}, "
            f"{self.default_coverage:.4f} at the default {DEFAULT_ENERGY:.3f}\n"
            f"log-likelihood a held-out posture: {self.log_likelihood:.6f}"
        )

    def meta(self) -> dict[str, str]:
        """Return the scores as texts by name, for the metadata of the mixture's file."""
        return {
            "held_out": str(self.postures),
            "held_out_log_likelihood": f"{self.log_likelihood:.6f}",
            "acceptance_paper_coverage": f"{self.paper_coverage:.4f}",
            "acceptance_default_coverage": f"{self.default_coverage:.4f}",
            "mean_absolute_error": f"{self.mean_error:.4f}",
            "mean_absolute_errors": " ".join(f"{error:.4f}" for error in self.error.tolist()),
        }


def evaluate_mixture(mixture: GraspMixture, samples: HandSamples) -> MixtureScore:
    """Return the errors of the joints that a posture model predicts from contact codes.

    `samples` are postures of the same hand, with their codes, that the model was not trained on.
    Their joints count as the true ones. The result also has the log-likelihood of `samples`, and
    the share of their codes that the model takes for reachable.
    Raises `BadArgument` for fewer than two postures, or for other joints than the model's.
    """
    if samples.joint_names != mixture.joint_names:
        allowed = f"the mixture's {mixture.joint_names}"
        raise BadArgument("samples", f"joints {samples.joint_names}", allowed)
    if len(samples) < 2:
        raise BadArgument("samples", f"{len(samples)} postures", "at least 2")
    joints = samples.joints.double()
    q = samples.q.double()
    error = (mixture.joints(q) - joints).abs()
    modes = mixture.modes(q, min(COMPARED_MODES, len(mixture.weights)))[0]
    energy = mixture.energy(q)
    return MixtureScore(
        joint_names=samples.joint_names,
        error=error.mean(0),
        deviation=error.std(0),
        nearest_mode=float((modes - joints[:, None]).abs().mean(-1).amin(-1).mean()),
        paper_coverage=float((energy < PAPER_ENERGY).double().mean()),
        default_coverage=float((energy < DEFAULT_ENERGY).double().mean()),
        log_likelihood=float(mixture.log_prob(samples.rows().double()).mean()),
        postures=len(samples),
    )


@dataclasses.dataclass(frozen=True)
class BicCurve(Value):
    """The Bayesian information criterion (BIC) of fits with k different numbers of Gaussians;
    smaller is better.
    """

    components: Int[Tensor, "k"]  # number of Gaussians of each fit
    bic: Float[Tensor, "k"]  # BIC (no unit) of each fit

    def __str__(self) -> str:
        """Return the BIC values as a table, with their minimum."""
        rows = [
            f"  {m:3d} {b:14.0f}"
            for m, b in zip(self.components.tolist(), self.bic.tolist(), strict=True)
        ]
        least = int(self.components[self.bic.argmin()])
        last = least == int(self.components.max())
        end = ", the largest asked for: no minimum is seen" if last else ""
        return "\n".join(["    m            BIC", *rows, f"least at {least}{end}"])


@checked
def growing_bic(
    samples: HandSamples, most: Count = 64, observer: Callable[[int], object] = lambda m: None
) -> BicCurve:
    """Return the Bayesian information criterion (BIC) of mixtures of 1 to `most` Gaussians, fitted
    to `samples` (Fig. 6 b, d of the paper).

    Each fit starts from the one before. The Gaussian of the greatest weight is split across its
    longest axis, and EM continues. The fits take no random number. The criterion belongs to the
    given postures: more postures support more Gaussians. Codes of "uniform" samples are exact
    functions of the joints, so the BIC falls without end. For "grasping" samples, whose fingertips
    roll, the BIC has a minimum. The `observer` is called with each number of Gaussians.

    Raises `BadArgument` for too few samples, codes not of three fingers, or a joint that does not
    vary. Raises `IndefiniteCovariance` if a Gaussian collapses more than three times: its
    covariance becomes singular, or it has too few samples.

    >>> numbers = torch.rand(500, 7, generator=torch.Generator().manual_seed(0))
    >>> growing_bic(HandSamples(numbers[:, :1], numbers[:, 1:], ("knuckle",)), most=3).components
    tensor([1, 2, 3])
    """
    shard, _, scale = standardised_rows(samples, most)
    start = start_components(shard, 1, 0, MAX_REGULARISATION)
    criterion = []
    for m, fit in zip(range(1, most + 1), growing_fits(shard, start, GROWING), strict=False):
        log_likelihood = float(fit.log_likelihood[-1] - scale.log().sum())  # in the samples' units
        criterion.append(information_criterion(fit.components, len(samples), log_likelihood))
        observer(m)
    return BicCurve(torch.arange(1, most + 1, device="cpu"), real(criterion))
