"""The model of success: boosted trees that predict a grasp's log-odds of success. Results of trials
calibrate it.

`scripts/train.py success` fits the model to trials of authored bodies. Trials of other families
calibrate it. Promises rest on these families, and on those of scanned and printed objects
(`scripts/train.py promise`).
"""

import dataclasses
import functools
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.files import read_value
from torchgrasp.foundation.base import Value, row_numbers

MODEL = Path(__file__).with_name("model.safetensors")
KIND = "success-model"
"""The shipped model, and the kind of its file."""


@dataclasses.dataclass(frozen=True)
class SuccessModel(Value):
    """Boosted decision trees that predict whether a grasp holds: t trees of m nodes; node 0 is the
    root.

    The input is k features of a grasp, in the order of `success.features.FEATURES`. Their units are
    in `success.features.CAUSES`. The output is the log-odds of success. Log-odds and shares, which
    are fractions in [0, 1], have no unit.
    """

    feature: Int[Tensor, "t m"]  # index, from 0, of the feature that a node reads
    # a grasp goes to the first child where the feature is at most this
    threshold: Float[Tensor, "t m"]
    children: Int[Tensor, "t m 2"]  # indices of a node's two children; a leaf is its own child
    value: Float[Tensor, "t m"]  # the log-odds that a leaf adds; 0 in other nodes
    start: Float[Tensor, ""]  # log-odds without any tree
    range: Float[Tensor, "k 2"]  # least and greatest value of each feature in the trials
    usual: Float[Tensor, "k"]  # the median of each feature among grasps that held
    # n ascending log-odds, each with the least and greatest share of such grasps that held in trials
    bands: Float[Tensor, "n 3"]
    # of r trials, each of the best grasp for a task: log-odds, 1 if it held (else 0), and the number
    # of the family of bodies
    kept: Float[Tensor, "r 3"]

    def log_odds(self, features: Float[Tensor, "g k"]) -> Float[Tensor, "g"]:
        """Return the log-odds (natural logarithm) of success of g grasps with k `features`, which
        are in the order of `FEATURES`.
        """
        node = torch.zeros(
            len(features), len(self.feature), dtype=torch.int64, device=features.device
        )
        trees = torch.arange(len(self.feature), device=features.device)
        rows = row_numbers(features)[:, None]
        for _ in range(self.depth):
            above = features[rows, self.feature[trees, node]] > self.threshold[trees, node]
            node = self.children[trees, node, above.long()]
        return self.start + self.value[trees, node].sum(1)

    def mean_log_odds(
        self, features: Float[Tensor, "c g k"], weights: Float[Tensor, "c"]
    ) -> Float[Tensor, "g"]:
        """Return the log-odds (g,) of each grasp's mean probability of success over c conditions.

        A condition is a pair of a friction and a mass. `features` are those of each grasp under
        each condition, in the order of `FEATURES`. `weights` (c,) are the probabilities of the
        conditions, of sum 1.
        """
        log_odds = self.log_odds(features.flatten(0, 1)).view(features.shape[:2])
        if len(log_odds) == 1:
            return log_odds[0]
        return torch.logit(weights.to(log_odds) @ torch.sigmoid(log_odds))

    @functools.cached_property
    def depth(self) -> int:
        """The number of steps from the root to the deepest leaf of all trees."""
        reached = torch.zeros(len(self.feature), 1, dtype=torch.int64, device=self.feature.device)
        trees = row_numbers(self.feature)[:, None]
        depth = 0
        while True:
            below = self.children[trees, reached].flatten(1)
            # a leaf is its own child
            if not bool((below != reached.repeat_interleave(2, 1)).any()):
                return depth
            reached = below
            depth = depth + 1

    def interval(self, log_odds: Float[Tensor, "*g"]) -> Float[Tensor, "*g 2"]:
        """Return the least and the greatest share (*g, 2) of grasps with given `log_odds` that held
        in trials, in [0, 1].

        The result has one pair for each of the `log_odds`, a tensor of any shape `*g`. Both are
        interpolated linearly between `bands`.
        """
        at = self.bands[:, 0].contiguous()
        low_high = self.bands[:, 1:]
        upper = torch.searchsorted(at, log_odds.to(at).contiguous()).clamp(1, len(at) - 1)
        share = ((log_odds - at[upper - 1]) / (at[upper] - at[upper - 1])).clamp(0, 1)[..., None]
        return torch.lerp(low_high[upper - 1], low_high[upper], share)


@functools.cache
def load_success_model(device: torch.device | str = "cpu") -> SuccessModel:
    """Return the model of success that torchgrasp ships, in float64 on a `device`.

    It is read once for each device, and then shared.
    """
    return read_value(MODEL, KIND, SuccessModel)[0].to(device)
