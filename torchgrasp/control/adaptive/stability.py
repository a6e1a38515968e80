"""Which grasps are stable [6]: Gaussian mixtures over stiffness, virtual-frame lengths and tactile forces of a hand.

Learned from simulated grasps that were pulled at (`scripts/train/stability.py`). Conditioned on the lengths of a grasp, the
mixture of those that held tells how firmly and how stiffly such grasps press, Sigma_fd of Eq. (28) included. Whether a
grasp in progress is stable is told by Bayes' rule, with a second mixture of those that did not hold: the density of the
stable ones alone, as in [6], falls as much with objects and stiffness that were rare among the trials as with forces
that do not hold. All nine numbers are logarithms, so that twice as strong is as far from a grasp as half as strong.
"""

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
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import find_hand
from torchgrasp.posture_model.compatibility import check_compatible
from torchgrasp.posture_model.em import expectation_maximisation
from torchgrasp.posture_model.gaussian import GaussianMixture
from torchgrasp.posture_model.kmeans import start_components
from torchgrasp.posture_model.shard import Shard

STIFFNESS, LENGTHS, FORCES = ("logK1", "logK2", "logK3"), ("logL1", "logL2", "logL3"), ("logF1", "logF2", "logF3")
NAMES = (*STIFFNESS, *LENGTHS, *FORCES)
"""Logarithms of the springs' stiffness [N/m], the distances of the fingertips' centres from the virtual frame's origin
[m], and the normal forces of the fingertips [N]."""

LEAST_FORCE = 0.05
"""Normal force [N] from which on a finger counts as one that does not press: half the sensor's noise."""

REGULARISATION = 0.05
"""Variance that a fit adds to every number of every component, relative to its variance over the trials: there are some
hundred of them, on a few bodies."""


def state_of(
    springs: Float[Tensor, "*b 3"], lengths: Float[Tensor, "*b 3"], forces: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 9"]:
    """Return the nine numbers of a grasp, in the order of `NAMES`.

    Args:
        springs: stiffness along the sides of the triangle of fingertips [N/m].
        lengths: `lengths_of` the fingertips [m].
        forces: normal forces [N].

    >>> state_of(torch.ones(3), torch.ones(3), torch.ones(3))
    tensor([0., 0., 0., 0., 0., 0., 0., 0., 0.])
    """
    return torch.cat([springs, lengths, forces.clamp_min(LEAST_FORCE)], -1).log()


def lengths_of(tips: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Return the distances of three fingertips' centres from the origin of their virtual frame [m] (Eq. 18)."""
    return torch.linalg.vector_norm(tips - tips.mean(-2, keepdim=True), dim=-1)


@dataclasses.dataclass(frozen=True)
class PreferredForces(Value):
    """How stable grasps press: normal forces [N], their covariance [N^2], and the springs' stiffness [N/m]."""

    forces: Float[Tensor, "3"]
    covariance: Float[Tensor, "3 3"]
    springs: Float[Tensor, "3"]


@dataclasses.dataclass(frozen=True)
class StabilityModel(Value):
    """What the trials of a hand tell of its grasps.

    Args:
        stable: density of the states (`NAMES`) of grasps that held.
        others: that of those that did not.
        share: of the trials that held.
        meta: hand, its hash and joints, bodies, trials, seed, and what the fit is worth on bodies left out.

    Raises:
        BadArgument: other names, or a share outside (0, 1).
    """

    stable: GaussianMixture
    others: GaussianMixture
    share: float
    meta: dict[str, str] = dataclasses.field(default_factory=dict[str, str])

    def __post_init__(self) -> None:
        """Check everything once, where the value is made."""
        for mixture in (self.stable, self.others):
            if mixture.names != NAMES:
                raise BadArgument("names", mixture.names, ", ".join(NAMES))
        if not 0.0 < self.share < 1.0:
            raise BadArgument("share", self.share, "a number in (0, 1)")

    def preferred_forces(self, tips: Float[Tensor, "3 3"], force: float | None = None) -> PreferredForces:
        """Return how stable grasps with fingertips so far apart press: the conditional given their lengths, as in [6].

        Forces are those of the conditional's mean (of the logarithms); their covariance is carried over by the
        derivative there.

        Args:
            tips: centres of the fingertips [m], in any frame.
            force: of the finger that is expected to press hardest [N], which is then given, too; None: none is.

        Raises:
            BadArgument: numbers that are not finite.
        """
        lengths = lengths_of(check_tensor("tips", tips, (3, 3)).double())
        given = dict(zip(LENGTHS, lengths.log().tolist(), strict=True))
        rest = self.stable.condition(given)
        mean, covariance = rest.marginal(FORCES).mean(), rest.marginal(FORCES).covariance()
        if force is not None:
            hardest = int(mean.argmax())
            given[FORCES[hardest]] = math.log(force)
            others = [i for i in range(3) if i != hardest]
            rest = self.stable.condition(given)
            part = rest.marginal([FORCES[i] for i in others])
            mean, covariance = torch.full_like(mean, math.log(force)), torch.zeros_like(covariance)
            mean[others] = part.mean()
            rows, columns = torch.meshgrid(torch.tensor(others), torch.tensor(others), indexing="ij")
            covariance[rows, columns] = part.covariance()
        forces = mean.exp()
        return PreferredForces(forces, forces[:, None] * covariance * forces, rest.marginal(STIFFNESS).mean().exp())

    def log_odds(self, state: Float[Tensor, "*b 9"]) -> Float[Tensor, "*b"]:
        """Return the logarithm of the odds that a grasp holds what pulled in the trials, by Bayes' rule; 0: even.

        Stiffness and forces are judged. The lengths tell more of the body than of the grasp: with them the estimate is
        worse on bodies that were not among the trials.
        """
        stable, others = self._judged
        seen = torch.cat([state[..., :3], state[..., 6:]], -1)
        return stable.log_prob(seen) - others.log_prob(seen) + math.log(self.share / (1 - self.share))

    @functools.cached_property
    def _judged(self) -> tuple[GaussianMixture, GaussianMixture]:
        """The densities of stiffness and forces, of grasps that held and of others."""
        return self.stable.marginal((*STIFFNESS, *FORCES)), self.others.marginal((*STIFFNESS, *FORCES))

    def save(self, path: Path | str) -> Path:
        """Write the model as safetensors, atomically; `load_stability` reads it back.

        Raises:
            OutputError: the file cannot be written.
        """
        tensors = {
            f"{kind}.{name}": getattr(mixture, name)
            for kind, mixture in (("stable", self.stable), ("others", self.others))
            for name in ("weights", "means", "covariances")
        }
        return save_tensors(path, "stability", tensors, {**self.meta, "share": repr(self.share)})


def fit_stability(
    stable: Float[Tensor, "n 9"],
    others: Float[Tensor, "k 9"],
    components: int,
    meta: dict[str, str] | None = None,
    seed: int = 0,
) -> StabilityModel:
    """Fit both mixtures by expectation-maximisation.

    Args:
        stable: states of grasps that held.
        others: states of those that did not.
        components: Gaussians of each mixture.
        meta: what the model tells about its hand and its trials.
        seed: of the start.

    Raises:
        BadArgument: hardly more states than a component has dimensions.
        IndefiniteCovariance: a component collapsed.
    """
    share = len(stable) / (len(stable) + len(others))
    return StabilityModel(_fit(stable, components, seed), _fit(others, components, seed), share, meta or {})


def _fit(states: Float[Tensor, "n 9"], components: int, seed: int) -> GaussianMixture:
    """Fit one mixture to standardised states."""
    n, d = states.shape
    if not 1 <= components <= n // (d + 2):
        raise BadArgument("components", f"{components} for {n} states", f"1 to {n // (d + 2)}")
    centre, scale = states.mean(0), states.std(0, correction=0)
    shard = Shard((states - centre) / scale)
    start = start_components(shard, components, seed, REGULARISATION)
    found = expectation_maximisation(shard, start, 300, 1e-4, REGULARISATION).components
    covariances = found.covariances * scale[:, None] * scale
    return GaussianMixture(found.weights, found.means * scale + centre, covariances, NAMES)


def load_stability(hand: Hand) -> StabilityModel | None:
    """Return the model of a hand's stable grasps from the hand's folder, or None where there is none.

    Raises:
        ModelFileError: the file is malformed.
        BadArgument: it is the model of another hand.
    """
    path = stability_path(hand.urdf_path.parent)
    return read_stability(path, hand) if path.is_file() else None


def stability_path(name_or_path: Path | str) -> Path:
    """Return where the model of a hand's stable grasps lies: stability.safetensors in the hand's folder.

    Raises:
        HandFileError: no such hand.
    """
    return find_hand(name_or_path) / "stability.safetensors"


def read_stability(path: Path | str, hand: Hand) -> StabilityModel:
    """Read a model that `StabilityModel.save` wrote, and refuse one of another hand.

    Raises:
        ModelFileError: the file is missing or malformed.
        BadArgument: it is the model of another hand.
    """
    parts = [f"{kind}.{name}" for kind in ("stable", "others") for name in ("weights", "means", "covariances")]
    tensors, meta = load_tensors(path, "stability", set(parts))
    try:
        joints, share = tuple(meta["joint_names"].split(",")), float(meta.pop("share"))
        stable, others = (
            GaussianMixture(tensors[f"{k}.weights"], tensors[f"{k}.means"], tensors[f"{k}.covariances"], NAMES)
            for k in ("stable", "others")
        )
        model = StabilityModel(stable, others, share, {k: v for k, v in meta.items() if k not in ("kind", "version")})
    except (KeyError, AttributeError, ValueError) as error:
        raise ModelFileError("path", f"{path}: {error}", "a model that StabilityModel.save wrote") from error
    check_compatible(meta, joints, hand)
    return model
