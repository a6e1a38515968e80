"""A promise: of the grasps that are returned, at least a given share holds. It is for objects of
families that nobody tried.

Grasps are returned whose log-odds of success are at least a bound. Families of bodies and objects
that the model was not fitted on choose the bound. The method is conformal risk control
(Angelopoulos et al., 2024). Let l_f be the mean of 1[returned] (1[failed] - alpha) over the trials
of family f, with alpha = 1 - promise. Returned grasps fail more often than promised if and only if
E l > 0. A new family has a loss of at most 1 - alpha. So the least bound is taken at which

    sum_f l_f + (1 - alpha) <= 0.

If the loss falls with the bound, the promise holds in the mean over n families and a new one. This
is true for every n, and this loss falls but for noise.
"""

import functools
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.success.model import load_success_model

BOUNDS = 200  # bounds of the log-odds that are tried, at equal steps


class Promise(NamedTuple):
    """A bound of the predicted success, above which a promised share of the grasps holds the
    object, by the evidence of trials.
    """

    least: float  # least predicted log-odds of success of a returned grasp
    trials: int  # number of trials from which this bound was determined
    families: int  # number of families of bodies in these trials


@functools.cache
def find_promise(share: float) -> Promise | None:
    """Return the least bound of the predicted success above which at least a `share` of the grasps
    holds the object.

    `share` is in [0, 1]. The trials of the shipped success model support it. None means that they
    support no bound.
    """
    log_odds, held, family = load_success_model().kept.unbind(1)
    least = least_log_odds(log_odds, held > 0, family.long(), share)
    return None if least is None else Promise(least, len(log_odds), len(family.unique()))


def describe_promise(share: float) -> str:
    """Return a text on the promise that at least a `share` of the returned grasps holds the object.

    The text names the `share`, in [0, 1], and the trials that support the promise. If no trials
    support it, the text says so.
    """
    promise = find_promise(share)
    if promise is None:
        return f"{share:g}, which no trials support"
    return (
        f"{share:g} by {promise.trials} trials of {promise.families} families: pulls and "
        "lifts of authored bodies, and of scanned and printed objects"
    )


def least_log_odds(
    log_odds: Float[Tensor, "r"], held: Bool[Tensor, "r"], family: Int[Tensor, "r"], share: float
) -> float | None:
    """Return the least bound of the log-odds of success above which at least a `share` of the
    grasps holds the object.

    None means that the trials support no bound. `share` is in [0, 1]. The bound is chosen by
    conformal risk control over families of bodies. It is the least b with sum_f l_f + `share` <= 0.
    Here l_f is the mean of 1[log-odds >= b] (1[failed] - (1 - `share`)) over the trials of family
    f.

    The r trials have the predicted `log_odds`. `held` says whether each grasp held, and `family`
    holds the number of its family of bodies.
    """
    if not len(log_odds):
        return None
    number = family.unique(return_inverse=True)[1]
    count = torch.bincount(number).to(log_odds)
    risk = (~held).to(log_odds) - (1 - share)
    least = float(log_odds.min())
    most = float(log_odds.max())
    bounds = torch.linspace(least, most, BOUNDS, dtype=log_odds.dtype)
    weighted = risk / count[number]  # its sum is that of the means of all families
    kept = torch.where(log_odds >= bounds[:, None], weighted, 0.0).sum(1) + share <= 0
    return float(bounds[kept][0]) if bool(kept.any()) else None
