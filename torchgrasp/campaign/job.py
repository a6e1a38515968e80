"""One job: plan on a view, try the grasps, return the record as the bytes of a shard's file. It runs anywhere."""

import importlib.metadata
import json

import torch

from torchgrasp.data.shards import JobRow, Records, Shard, pack_shard, short
from torchgrasp.errors import BadArgument, MissingExtra, OutputError, Status
from torchgrasp.evaluation.protocols import Protocol
from torchgrasp.evaluation.views import EvaluationSpec, View, choose_rows, plan_view, try_grasp
from torchgrasp.hand.hand import Hand
from torchgrasp.planner.grasps import no_grasps

PACKAGES = ("torchgrasp", "torch", "numpy", "scipy", "trimesh", "sapien", "mujoco", "coacd")
"""Packages on whose versions the numbers depend."""


def versions() -> dict[str, str]:
    """Return the versions of `PACKAGES` here; "none" where one is not installed."""
    from torchgrasp import __version__

    found = {"torchgrasp": __version__}  # of the source that runs; an installation may be older
    for name in PACKAGES[1:]:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "none"
    return found


def run_job(view: View, protocol: Protocol, spec: EvaluationSpec, meta: dict[str, str]) -> bytes:
    """Return the file of the shard that holds this job alone.

    Args:
        view: its object, and the hand.
        protocol: of the trials.
        spec: which grasps are tried.
        meta: of the file; `versions` are those that the campaign was begun with.

    Raises:
        BadArgument: other versions or another hand than the campaign's, as on a machine of a cluster.
        MissingExtra, OutputError, OSError: no fault of the object, whose own files are refused by name.
    """
    hand, here = view.load_hand(), json.dumps(versions())
    if here != meta["versions"]:
        raise BadArgument("workers", f"one with {here}", f"workers with {meta['versions']}")
    if hand.source.sha256 != view.hand.sha256:
        raise BadArgument("hand", f"{view.hand.urdf_path} with other files", "the same hand on every machine")
    try:
        shard = _work(view, hand, protocol, spec)
    except (MissingExtra, OutputError, MemoryError, OSError):
        raise
    except Exception as error:  # of the library: a week of other jobs shall not end with it
        row = JobRow(view.object, view.view, Status.BROKEN, short(f"{type(error).__name__}: {error}"))
        shard = empty_shard(row, hand, protocol.noise.draws)
    return pack_shard(shard, meta)


def _work(view: View, hand: Hand, protocol: Protocol, spec: EvaluationSpec) -> Shard:
    """Plan, and try the chosen grasps."""
    score, cloud, found = plan_view(view, protocol.trial.friction, spec)
    row = JobRow(view.object, view.view, score.refusal, short(score.note), score.family, score.group)
    if cloud is None or found is None:
        return empty_shard(row, hand, protocol.noise.draws)
    ranks = choose_rows(len(found), spec.grasps, spec.ranks)
    grasps, draws = found[ranks], range(protocol.noise.draws)
    tries = [try_grasp(view, found[rank], protocol, spec, (rank, draw)) for rank in ranks for draw in draws]
    passed = torch.tensor([x.passed for x in tries], dtype=torch.bool).reshape(len(ranks), len(draws))
    outcome = torch.tensor([int(x.status) for x in tries], dtype=torch.int64).reshape(passed.shape)
    eye = torch.zeros(3, dtype=torch.float64) if cloud.viewpoint is None else cloud.viewpoint.double()
    row = row._replace(
        executable=len(found), points=len(cloud), grasps=len(ranks), passed=int(passed.sum()), meta=found.meta
    )
    return Shard((row,), Records(cloud.points.double(), eye[None], grasps, passed, outcome))


def empty_shard(row: JobRow, hand: Hand, draws: int) -> Shard:
    """Return the shard of a job without cloud and grasps."""
    points, tried = torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, draws, dtype=torch.int64)
    return Shard((row,), Records(points, torch.zeros(1, 3, dtype=torch.float64), no_grasps(hand), tried.bool(), tried))
