"""How many of the library's grasps pass a published protocol, each planned on what one camera saw."""

import dataclasses
import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchgrasp.close.control import ClosingMode
from torchgrasp.close.parts import convex_parts
from torchgrasp.close.protocol import PullProtocol, PullResult, check_test, draw_errors, pull_grasp
from torchgrasp.errors import BadArgument, Status
from torchgrasp.hand.hand import Hand
from torchgrasp.pipeline import plan_grasps
from torchgrasp.shape.calibrate import read_views, read_whole
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Grasps

if TYPE_CHECKING:
    import trimesh

MOST_FRICTION = 1.0
"""The most friction that grasps are planned for, however much a protocol grants."""


@dataclasses.dataclass(frozen=True)
class ViewScore:
    """What became of the best grasps of one view of one object, in the order of their rank.

    `executable` counts the grasps that the planner offered and `seconds` is the CPU time of planning all of them. Where
    the protocol draws errors of the hand's pose, each grasp has as many results.
    """

    object: str
    view: str
    executable: int
    seconds: float
    results: tuple[PullResult, ...]


def evaluate(
    objects: Path,
    hand: Hand,
    protocol: PullProtocol | str = "dexgraspbench",
    grasps: int = 20,
    starts: int = 1000,
    seed: int = 0,
    force: float = 7.0,
    closing: ClosingMode = "open_loop",
    complete: bool = False,
    only: Sequence[str] = (),
    observer: Callable[[ViewScore], None] | None = None,
) -> list[ViewScore]:
    """Plan on every view of every object of a folder, and put the best grasps of each to the test.

    The planner sees the noisy cloud, the camera's position, the friction and, as the objects stand on it, the height of
    the table; the true mesh is the simulator's alone.

    Args:
        objects: folder with manifest.json, and for each object mesh.ply and noisy views.
        hand: the hand.
        protocol: one of `PROTOCOLS` by name, or another.
        grasps: the most that are tried of each view, the best first.
        starts: of the contact planner.
        seed: of every random draw.
        force: normal force of the strongest finger [N] in the squeeze; the others balance it.
        closing: how the hand closes.
        complete: plan on the whole cloud with its normals instead: what a perfect shape is worth.
        only: names of objects to keep; by default all.
        observer: called with each score as it is there.

    Raises:
        BadArgument: an unknown protocol or closing, a force or count outside its range, or no objects.
        MissingExtra: the simulator is not installed.
    """
    protocol = check_test(protocol, force, closing)
    if grasps < 1:
        raise BadArgument("grasps", grasps, "at least 1")
    spec = ContactSpec(friction=min(protocol.friction, MOST_FRICTION), table=0.0)
    scores = []
    for name, view, cloud, mesh in (read_whole if complete else read_views)(objects, only=only):
        began = time.process_time()
        found = plan_grasps(cloud, hand, spec, starts, seed)
        found = found[found.status == Status.OK]
        seconds = time.process_time() - began
        results = try_grasps(found[:grasps], hand, mesh, protocol, force, closing, seed)
        scores.append(ViewScore(name, view, len(found), seconds, results))
        if observer:
            observer(scores[-1])
    return scores


def try_grasps(
    grasps: Grasps,
    hand: Hand,
    mesh: "trimesh.Trimesh",
    protocol: PullProtocol,
    force: float,
    closing: ClosingMode,
    seed: int,
) -> tuple[PullResult, ...]:
    """Return what becomes of each grasp with each of its drawn errors, grasp by grasp."""
    parts = convex_parts(mesh)
    errors = draw_errors(protocol, len(grasps), seed)
    return tuple(
        pull_grasp(grasp, hand, mesh, protocol, force, closing, seed, error=error, parts=parts)
        for grasp, drawn in zip(grasps, errors, strict=True)
        for error in drawn
    )


def summarise(scores: Sequence[ViewScore]) -> dict[str, Any]:
    """Return shares with their 95 % Wilson intervals, forces, times and reasons of failure, by name.

    "gsr" is the share of all tried grasps that passed, "top1" that of the views whose best grasp did (a view without
    any counts as failed), "objects" the share of objects with a success, "refused" the views without a grasp.
    """
    every = [result for score in scores for result in score.results]
    names = sorted({score.object for score in scores})
    won = {score.object for score in scores if any(result.passed for result in score.results)}
    forces = [result.force for result in every if not math.isnan(result.force)]
    return {
        "gsr": share(sum(result.passed for result in every), len(every)),
        "top1": share(sum(bool(s.results) and s.results[0].passed for s in scores), len(scores)),
        "objects": share(len(won), len(names)),
        "refused": sum(not score.results for score in scores),
        "force_n": sum(forces) / len(forces) if forces else None,
        "plan_cpu_s": sum(score.seconds for score in scores) / max(len(scores), 1),
        "trial_cpu_s": sum(result.seconds for result in every) / max(len(every), 1),
        "failures": dict(Counter(result.status.name for result in every if not result.passed)),
    }


def share(count: int, total: int) -> tuple[float, float, float, int]:
    """Return a share, its 95 % Wilson interval, and of how many it is one.

    >>> [round(x, 2) for x in share(9, 10)]
    [0.9, 0.6, 0.98, 10]
    """
    from scipy.stats import binomtest

    if not total:
        return 0.0, 0.0, 1.0, 0
    interval = binomtest(count, total).proportion_ci(method="wilson")
    return count / total, float(interval.low), float(interval.high), total
