"""The order of grasps: by their predicted success in the task, or by the variance at contacts."""

import dataclasses
from collections.abc import Sequence
from itertools import accumulate

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.contacts.resist import resist_loads
from torchgrasp.foundation.base import flatnonzero, join
from torchgrasp.foundation.errors import Status
from torchgrasp.ik.motion import collision_probability
from torchgrasp.planner.objects import CloudIndex, Objects
from torchgrasp.success.features import lost_by_weakness, measure_grasps, weights_carried
from torchgrasp.success.loads import strength_of
from torchgrasp.success.model import load_success_model
from torchgrasp.success.order import (
    by_success,
    covered_share,
    grade,
    keep_promise,
    rank_by_variance,
)
from torchgrasp.success.task import Conditions
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.planning import Grasps
from torchgrasp.values.specs import Ranking

SURE = 1e-6
"""Probability that stands for 0 in log-odds, so that they stay finite."""
BEST = 20
"""Number of best grasps by which a set of fingers is judged. It is as many as an evaluation tries
of a view.
"""


def rank(objects: Objects, grasps: Grasps, cloud: CloudIndex) -> list[Grasps]:
    """Return for each object its grasps, best first, on the CPU.

    The best grasp has the greatest predicted success, or the least variance of the surface at its
    contacts (`Request.order`). A grasp's `score` is the log-odds of its success. `cloud` (g,) is
    the index of each grasp's object. If the object cannot be lifted out of its surroundings, its
    grasps get the status `BURIED`. Grasps that the arm cannot follow get `UNREACHABLE`, and grasps
    that resist less than the loads `NOT_RESISTED`. Grasps of less success than a promise needs get
    `NO_PROMISE`.
    """
    request = objects.request
    if objects.buried:
        lost = torch.where(grasps.status == Status.OK, int(Status.BURIED), grasps.status)
        grasps = dataclasses.replace(grasps, status=lost)
    grasps = objects.on_arm(grasps)
    grasps = prove_resistance(objects, grasps, cloud)
    rows = flatnonzero(grasps.status == Status.OK)
    log_odds, covered = predict(objects, grasps[rows], cloud[rows])
    # the host sorts
    cpu = torch.device("cpu")
    cloud = cloud.cpu()
    vague = torch.tensor([one.vague for one in objects.each])
    covered = covered.cpu().masked_fill(vague[cloud[rows.cpu()]], 0.0)
    graded = grade(grasps.to(cpu), log_odds.cpu(), covered)
    if request.promise is not None:
        graded = keep_promise(graded, request.promise)
    ranked = by_success(graded, cloud)
    counts = torch.bincount(cloud, minlength=len(objects)).tolist()
    found = [
        ranked[last - count : last] for last, count in zip(accumulate(counts), counts, strict=True)
    ]
    return found if request.order == "success" else [rank_by_variance(one) for one in found]


def predict(
    objects: Objects, grasps: Grasps, cloud: CloudIndex
) -> tuple[Float[Tensor, "g"], Float[Tensor, "g"]]:
    """Return two numbers for each of g grasps: the log-odds of its success, and how far trials
    cover it.

    The second is the share, in [0, 1], of the conditions for which similar grasps were tried. The
    conditions are the distributions of friction and mass; the success is the mean over them. The
    log-odds fall where the fingers can hardly carry the mean weight with the mean friction
    (`lost_by_weakness`). With obstacles, success also needs that the hand hits none. `cloud` (g,) is the index
    of each grasp's object.
    """
    task = objects.request.grasp_task
    spec = objects.spec
    conditions = Conditions.of(spec.friction, task.mass)
    features = measure_grasps(
        objects.hand,
        objects.body.rows(cloud),
        grasps,
        conditions,
        task,
        task.lifts(spec.plane),
    )
    model = load_success_model(features.device)
    log_odds = model.mean_log_odds(features, conditions.weights)
    if task.lifts(spec.plane):
        center = objects.body.rows(cloud).center
        mass = Distribution.of(task.mass).mean
        carried = weights_carried(
            objects.hand, grasps, center, mass, objects.spec_without_margin, objects.strongest
        )
        log_odds = log_odds - lost_by_weakness(carried)
    obstacles = objects.world.obstacles
    if obstacles is not None:
        hit = collision_probability(objects.hand, grasps, obstacles, spec.plane)
        free = 1 - hit.to(log_odds)
        log_odds = torch.logit(torch.sigmoid(log_odds) * free, eps=SURE)
    return log_odds, covered_share(features, conditions)


def prove_resistance(objects: Objects, grasps: Grasps, cloud: CloudIndex) -> Grasps:
    """Return the grasps; their certificates now prove which loads they resist.

    The proof is in the fields `task_margin` to `task_strength` of `Certificate`. The `task_margin`
    is the greatest multiple of the loads that a grasp resists. Executable grasps with a margin
    below 1 get the status `NOT_RESISTED`. Without loads to resist the grasps are returned as they
    are. `cloud` is the index of each grasp's object.
    """
    if objects.loads is None:
        return grasps
    contacts = grasps.contacts
    strength = strength_of(objects.hand, grasps, contacts, objects.strongest)
    loads = objects.loads[cloud]  # (g, w, 6)
    proof = resist_loads(contacts.points, contacts.normals, strength, loads, objects.spec)
    weak = (grasps.status == Status.OK) & ~(proof.margin >= 1)
    status = grasps.status.masked_fill(weak, int(Status.NOT_RESISTED))
    fields = dict(
        zip(("task_margin", "task_load", "task_twist", "task_forces"), proof, strict=True)
    )
    proven = dataclasses.replace(grasps.certificate, task_strength=strength, **fields)
    return dataclasses.replace(grasps, certificate=proven, status=status)


def rank_together(batches: Sequence[Grasps], ranking: Ranking) -> Grasps:
    """Return the grasps of all batches in one order, the executable ones first.

    `ranking` puts those of the greatest predicted "success" first, or of the least "variance". The
    result has the metadata of the last batch.
    """
    ranked = by_success(join(batches))
    ranked = ranked if ranking == "success" else rank_by_variance(ranked)
    return dataclasses.replace(ranked, meta=batches[-1].meta)


def expected_success(grasps: Grasps, best: int = BEST) -> float:
    """Return the mean predicted success, in [0, 1], of the `best` (by default 20) best executable
    grasps.

    Each grasp that is missing counts as 0.
    """
    likely = torch.where(grasps.status == Status.OK, torch.sigmoid(grasps.score), 0.0)
    return float(likely.sort(descending=True).values[:best].sum()) / best
