"""The learned stability model, from the paper's reference [6]: Gaussian mixtures over stiffness,
size and forces of grasps.

Two mixtures are fitted to simulated pulls, of stable and of unstable grasps (`scripts/train.py
stability` of commit 94e35b96). The first gives the forces of stable grasps and Sigma_fd of Eq. (28).
Both give the probability of stability by Bayes' rule. The density of stable grasps alone, as in
[6], is also low for rare objects.
"""

import dataclasses
import functools
import math
from pathlib import Path
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.finger_forces import PreferredForces
from torchgrasp.files import load_tensors, save_tensors
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, ModelFileError
from torchgrasp.foundation.rules import LEAST, Positive, Range
from torchgrasp.geometry.linalg import norm
from torchgrasp.hand.hand import Hand
from torchgrasp.posture_model.gaussian import GaussianMixture
from torchgrasp.posture_model.mixture import check_compatible

STIFFNESS = ("logK1", "logK2", "logK3")
LENGTHS = ("logL1", "logL2", "logL3")
FORCES = ("logF1", "logF2", "logF3")
"""Logarithms of spring stiffness [N/m], of the tips' distances from their virtual frame [m], of
normal forces [N].
"""
NAMES = (*STIFFNESS, *LENGTHS, *FORCES)  # components of the state of a grasp
LEAST_FORCE = 0.05  # least normal force [N] of a finger in a state
FILE = "stability.safetensors"  # name of the model in the hand's folder
PARTS = [
    (kind, part) for kind in ("stable", "others") for part in ("weights", "means", "covariances")
]
"""Tensors of a model file."""


def state_of(
    springs: Float[Tensor, "*b 3"], lengths: Float[Tensor, "*b 3"], forces: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 9"]:
    """Return the state of a grasp: the natural logarithms of three stiffnesses, three distances and
    three forces.

    `springs` [N/m] are the stiffnesses of the virtual springs. `lengths` [m] are the distances of
    the fingertips from their centroid, and `forces` [N] their normal forces. All are in the order
    of the hand's fingers.
    """
    return torch.cat([springs, lengths, forces.clamp_min(LEAST_FORCE)], -1).log()


def lengths_of(tips: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Return the distances (*b, 3) [m] of three fingertips, with centres `tips` (*b, 3, 3) [m],
    from their centroid.
    """
    return norm(tips - tips.mean(-2, keepdim=True))


@checked
@dataclasses.dataclass(frozen=True)
class StabilityModel(Value):
    """The learned stability model of one hand: two Gaussian mixtures over the states of grasps.

    A state (`state_of`) holds the natural logarithms of nine numbers, three of each kind. These are
    the stiffnesses of the virtual springs [N/m], the distances of the fingertips from their
    centroid [m], and the normal forces [N]. `stable` is the density of stable grasps, `others` that
    of all others. `share` is the prior probability of stable grasps. `meta` holds texts on the
    hand, the bodies, trials, seed and scores.
    """

    stable: GaussianMixture  # density of the states of stable grasps
    others: GaussianMixture  # density of the states of all other grasps
    share: Annotated[
        float, Range(LEAST, 1 - 2**-53, "a number in (0, 1)")
    ]  # share of stable trials: the prior
    meta: dict[str, str] = dataclasses.field(
        default_factory=dict[str, str]
    )  # texts: hand, bodies, trials, seed, scores

    def __post_init__(self) -> None:
        for mixture in (self.stable, self.others):
            if mixture.names != NAMES:
                raise BadArgument("names", mixture.names, ", ".join(NAMES))

    @checked
    def preferred_forces(
        self, tips: Float[Tensor, "3 3"], force: Positive | None = None
    ) -> PreferredForces:
        """Return the typical forces [N] and stiffnesses [N/m] of stable grasps with fingertip
        centres `tips` [m].

        Only the distances of the tips from their centroid count, so `tips` may be in any frame.
        `force` [N] is the normal force of the finger that presses hardest; None means that the
        model chooses it.
        """
        lengths = lengths_of(tips.double())
        given: dict[str, float] = dict(zip(LENGTHS, lengths.log().tolist(), strict=True))
        rest = self.stable.condition(given)
        mean = rest.marginal(FORCES).mean()
        covariance = rest.marginal(FORCES).covariance()
        if force is not None:
            hardest = int(mean.argmax())
            given[FORCES[hardest]] = math.log(force)
            others = [i for i in range(3) if i != hardest]
            rest = self.stable.condition(given)
            part = rest.marginal([FORCES[i] for i in others])
            mean = torch.full_like(mean, math.log(force))
            covariance = torch.zeros_like(covariance)
            mean[others] = part.mean()
            covariance[[[i] for i in others], others] = part.covariance()
        forces = mean.exp()
        springs = rest.marginal(STIFFNESS).mean().exp()
        return PreferredForces(forces, forces[:, None] * covariance * forces, springs)

    @checked(gradients=True)
    def log_odds(self, state: Float[Tensor, "*b 9"]) -> Float[Tensor, "*b"]:
        """Return the natural log-odds (*b) that grasps with a `state` are stable, by Bayes' rule.

        `state` (*b, 9) holds the logarithms of three stiffnesses, distances and forces
        (`state_of`). The three distances do not count. `*b` stands for any leading axes.
        """
        stable, others = self._without_lengths
        judged = torch.cat([state[..., :3], state[..., 6:]], -1)  # (*b, 6)
        ratio = stable.log_prob(judged) - others.log_prob(judged)
        return ratio + math.log(self.share / (1 - self.share))

    @functools.cached_property
    def _without_lengths(self) -> tuple[GaussianMixture, GaussianMixture]:
        """The models of stable and of other grasps over stiffness and forces, without fingertip
        distances.
        """
        left = (*STIFFNESS, *FORCES)
        return self.stable.marginal(left), self.others.marginal(left)

    @checked
    def save(self, path: Path | str) -> Path:
        """Write the model to a safetensors file, atomically, and return its path; `load_stability`
        reads the file.
        """
        tensors = {f"{kind}.{part}": getattr(getattr(self, kind), part) for kind, part in PARTS}
        return save_tensors(path, "stability", tensors, {**self.meta, "share": repr(self.share)})


@checked
def load_stability(hand: Hand, path: Path | str | None = None) -> StabilityModel | None:
    """Return the stability model of a hand, read from `path`; None means stability.safetensors in
    the hand's folder.

    Return None if `path` is None and the hand's folder has no such file. Raises `ModelFileError`
    for a malformed file.
    """
    if path is None:
        path = hand.urdf_path.parent / FILE
        if not path.is_file():
            return None
    tensors, meta = load_tensors(path, "stability", {f"{kind}.{part}" for kind, part in PARTS})
    try:
        joints = tuple(meta["joint_names"].split(","))
        share = float(meta.pop("share"))
        stable, others = (
            GaussianMixture(
                tensors[f"{k}.weights"], tensors[f"{k}.means"], tensors[f"{k}.covariances"], NAMES
            )
            for k in ("stable", "others")
        )
        model = StabilityModel(stable, others, share, meta)
    except (KeyError, AttributeError, ValueError) as error:
        raise ModelFileError(
            "path", f"{path}: {error}", "a model that StabilityModel.save wrote"
        ) from error
    check_compatible(meta, joints, hand)
    return model
