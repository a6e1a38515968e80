"""The order of grasps by predicted success for a task. Or the order by the variance at the
contacts, as in the paper.
"""

import dataclasses
import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.base import flatnonzero, lexical_order
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.success.features import FEATURES
from torchgrasp.success.model import load_success_model
from torchgrasp.success.promise import find_promise
from torchgrasp.success.task import Conditions
from torchgrasp.values.planning import Grasps

DOMAIN = ("deviation", "size", "height", "friction", "mass", "force")
"""Features that must lie within the range of the trials; otherwise the success of a grasp is
unknown.
"""
UNKNOWN = 0.1
"""Largest probability of a friction or mass outside of the trials at which success counts as known.
More would break the promise that 0.9 of the grasps hold.
"""


def is_covered(features: Float[Tensor, "g k"], names: Sequence[str] = DOMAIN) -> Bool[Tensor, "g"]:
    """Return a mask of the g grasps for which trials support the prediction of success.

    `features` (g, k) are those of the success model, in the order of the tuple `FEATURES`. Trials
    support a prediction if the features called `names` lie within their range in the trials of the
    success model.
    """
    rows = [FEATURES.index(name) for name in names]
    least, most = load_success_model(features.device).range[rows].T
    found = features[:, rows]
    return ((found >= least) & (found <= most)).all(1)


def covered_share(features: Float[Tensor, "c g k"], conditions: Conditions) -> Float[Tensor, "g"]:
    """Return for each of g grasps the probability that friction and mass lie within the range of
    the model's trials.

    It is 0 if another feature lies outside of this range: the surface's deviation, size or height
    of the object, or force. `features` hold k features of g grasps for each of c pairs of a
    friction and a mass (`conditions`).
    """
    others = [name for name in DOMAIN if name not in ("friction", "mass")]
    return supported_share(conditions) * is_covered(features[0], others).to(features)


def supported_share(conditions: Conditions) -> float:
    """Return the probability that friction and mass both lie within their range in the trials of
    the success model.

    They are independent, and distributed as in `conditions`.
    """
    share = 1.0
    for name, law in (("friction", conditions.friction), ("mass", conditions.mass)):
        least, most = load_success_model().range[FEATURES.index(name)].tolist()
        share *= law.share(least, most)
    return share


def largest_known() -> float:
    """Return the largest half size [m] of the objects in the trials of the success model; for
    larger ones, success is unknown.

    The half size is the length of a normalised unit of the estimated shape.
    """
    return float(load_success_model().range[FEATURES.index("size"), 1])


def grade(grasps: Grasps, log_odds: Float[Tensor, "k"], covered: Float[Tensor, "k"]) -> Grasps:
    """Return the grasps, in which the k executable ones get new values of `score`, `interval` and
    `known`.

    The score is `log_odds`, the predicted log-odds of success. `covered` is the probability that
    friction and mass are within the range of the model's trials. Of the rest, 1 - `covered`,
    nothing is known. So the interval is that of the success model times `covered`, and its upper
    end is greater by the rest. A grasp is known if the rest is at most 0.1 (`UNKNOWN`); otherwise
    its interval is [0, 1]. Failed grasps keep their score; their interval is [0, 0], and they count
    as known.
    """
    known = covered >= 1 - UNKNOWN
    good = flatnonzero(grasps.status == Status.OK)
    score = grasps.score.clone()
    score[good] = log_odds.to(score)
    interval = torch.zeros_like(score)[:, None].repeat(1, 2)
    supported = torch.ones_like(score, dtype=torch.bool)
    bounds = load_success_model(log_odds.device).interval(log_odds)
    bounds = covered[:, None] * bounds
    bounds[:, 1] += 1 - covered
    bounds = bounds.where(known[:, None], log_odds.new_tensor([0.0, 1.0]))
    interval[good] = bounds.to(score)
    supported[good] = known
    return dataclasses.replace(grasps, score=score, interval=interval, known=supported)


def keep_promise(grasps: Grasps, share: float) -> Grasps:
    """Return the grasps with the status `NO_PROMISE` for executable ones whose predicted success is
    too low for a promise.

    The promise is that at least a `share`, in [0, 1], of the grasps that stay executable hold.
    `find_promise` gives the bound of the log-odds for this share. An executable grasp keeps its
    status if its success is known and its log-odds are at least this bound. Without a bound, none
    keeps it.
    """
    promise = find_promise(share)
    least = math.inf if promise is None else promise.least
    sure = grasps.score >= least if grasps.known is None else (grasps.score >= least) & grasps.known
    broken = (grasps.status == Status.OK) & ~sure
    return dataclasses.replace(
        grasps, status=grasps.status.masked_fill(broken, int(Status.NO_PROMISE))
    )


def by_success(grasps: Grasps, *groups: Int[Tensor, "g"]) -> Grasps:
    """Return grasps sorted by the keys `groups`, and those of equal keys by predicted success.

    Each key holds a number for each of the g grasps, and the smallest comes first. The first key
    counts most; without keys, only the success counts. Executable grasps with a known success come
    first, then other executable ones, then failed ones. Each of these classes is in falling order
    of the score. Between equal scores, the greater margin of the certificate comes first.

    With an arm (`grasps.ease` is not None), each class is sorted by the success in whole per cent.
    Between equal ones, the greater product of the numbers in `grasps.ease` comes first. These
    grasps are easily reached. Then the score and the margin count, as without an arm.
    """
    late = 2 * (grasps.status != Status.OK).int()
    late = late if grasps.known is None else late + (~grasps.known & (late == 0)).int()
    if grasps.ease is not None:
        late = late.double() + (1 - torch.round(torch.sigmoid(grasps.score), decimals=2)) / 2
        groups = *groups, late, -grasps.ease.prod(1)
    return grasps[lexical_order(*groups, late, -grasps.score, -grasps.certificate.margin)]


def rank_by_variance(grasps: Grasps) -> Grasps:
    """Return grasps sorted as in the paper (Sec. 6.5): executable ones first, then by increasing
    sum of the variances at contacts.

    Raises `BadArgument` if the variance of the surface at the contacts is unknown.
    """
    if grasps.contacts.variance is None:
        raise BadArgument(
            "grasps.contacts.variance", "None", "the variance of the surface at each contact"
        )
    return grasps[
        lexical_order((grasps.status != Status.OK).int(), grasps.contacts.variance.sum(1))
    ]
