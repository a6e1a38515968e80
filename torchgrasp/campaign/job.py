"""One job of a campaign: grasps are planned on one view of an object, and tried in simulation."""

import contextlib
import importlib.metadata
import json
from typing import Any

import torch

from torchgrasp.data.shards import JobRow, Records, Shard, pack_shard, short
from torchgrasp.evaluation.protocols import Protocol
from torchgrasp.evaluation.views import (
    EvaluationSpec,
    ObjectView,
    choose_rows,
    plan_view,
    plan_views,
    try_grasp,
)
from torchgrasp.foundation.errors import BadArgument, MissingExtra, OutputError, Status
from torchgrasp.hand.hand import Hand
from torchgrasp.planner.many import no_grasps
from torchgrasp.values.planning import Grasps

PACKAGES = ("torchgrasp", "torch", "numpy", "scipy", "trimesh", "sapien", "mujoco", "coacd")
"""Packages whose versions may change the results of a campaign."""


def versions() -> dict[str, str]:
    """Return the installed versions, by name, of torchgrasp and the packages that may change a
    campaign's results (`PACKAGES`). "none" means that a package is not installed.
    """
    from torchgrasp import __version__

    found: dict[str, str] = dict.fromkeys(PACKAGES, "none")
    found["torchgrasp"] = __version__  # of the source; an installation may be older
    for name in PACKAGES[1:]:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def check_versions(meta: dict[str, str]) -> None:
    """Raise `BadArgument` unless this machine has the package versions with which a campaign began.

    `meta["versions"]` holds these versions as JSON, as `versions()` returned them.
    """
    here = json.dumps(versions())
    if here != meta["versions"]:
        raise BadArgument("workers", f"one with {here}", f"workers with {meta['versions']}")


def plan_jobs(meta: dict[str, str], *task: Any) -> list[Grasps | None]:
    """Plan several jobs at once, and return the executable grasps of each: those that passed all
    checks.

    A job is one view of one object. A job that could not be planned has None. `task` holds the
    arguments of `plan_views`: views, protocol, options and device. `meta["versions"]` holds the
    software versions at the campaign's start, as JSON. Raises `BadArgument` on a machine with
    others.
    """
    check_versions(meta)
    return plan_views(*task)


def run_job(
    view: ObjectView,
    protocol: Protocol,
    spec: EvaluationSpec,
    meta: dict[str, str],
    plans: object = None,
    place: int = 0,
) -> bytes:
    """Plan grasps on a `view` and try them in simulation; return the bytes of a shard file of this
    job.

    `protocol` is the test of each grasp, and `spec` says which grasps are tried. `meta` is the
    metadata of the file; its "versions" are those of the software with which the campaign began. If
    `plans` is the list that `plan_jobs` returned, the job's plan is `plans[place]`. If `plans` is
    None, or the `Status` of a planning that took too long, the job is planned here.

    A faulty object gives a `JobRow` with the reason; an unexpected error gives `Status.BROKEN`.
    Raises `BadArgument` on a machine with other versions or another hand. A missing package, a full
    disk and lack of memory also raise errors.
    """
    check_versions(meta)
    hand = view.load_hand()
    if hand.source.sha256 != view.hand.sha256:
        found = f"{view.hand.urdf_path} with other files"
        raise BadArgument("hand", found, "the same hand on every machine")
    plan = plans[place] if isinstance(plans, list) else None
    try:
        shard = _work(view, hand, protocol, spec, plan)
    except (MissingExtra, OutputError, MemoryError, OSError):
        raise
    except Exception as error:  # of the library: a week of other jobs shall not end with it
        note = short(f"{type(error).__name__}: {error}")
        row = JobRow(view.object, view.view, Status.BROKEN, note)
        shard = empty_shard(row, hand, protocol.noise.draws)
    return pack_shard(shard, meta)


def _work(
    view: ObjectView, hand: Hand, protocol: Protocol, spec: EvaluationSpec, plan: Grasps | None
) -> Shard:
    """Plan grasps on the view of a job unless there is a plan, and try the chosen grasps in
    simulation.
    """
    score, cloud, found = plan_view(view, protocol, spec, plan)
    note = short(score.note)
    row = JobRow(view.object, view.view, score.refusal, note, score.family, score.group)
    draws = protocol.noise.draws
    if cloud is None or found is None:
        return empty_shard(row, hand, draws)
    ranks = choose_rows(len(found), spec.grasps, spec.ranks)
    passed = torch.zeros(len(ranks), draws, dtype=torch.bool)
    outcome = torch.zeros(passed.shape, dtype=torch.int64)
    for k, rank in enumerate(ranks):
        for draw in range(draws):
            tried = try_grasp(view, found, protocol, spec, (rank, draw))
            passed[k, draw] = tried.passed
            outcome[k, draw] = int(tried.status)
    row = row._replace(
        executable=len(found),
        points=len(cloud),
        grasps=len(ranks),
        passed=int(passed.sum()),
        meta=found.meta,
    )
    eye = torch.zeros(3) if cloud.viewpoint is None else cloud.viewpoint
    points = cloud.points.double()
    return Shard((row,), Records(points, eye.double()[None], found[ranks], passed, outcome))


def empty_shard(row: JobRow, hand: Hand, draws: int) -> Shard:
    """Return the shard (the data) of a single job that has neither a cloud nor grasps.

    `row` is its outcome, `hand` the campaign's hand, and `draws` the number of trials of each grasp
    in the campaign.
    """
    points = torch.zeros(0, 3, dtype=torch.float64)
    eye = torch.zeros(1, 3, dtype=torch.float64)
    tried = torch.zeros(0, draws, dtype=torch.int64)
    return Shard((row,), Records(points, eye, no_grasps(hand), tried.bool(), tried))
