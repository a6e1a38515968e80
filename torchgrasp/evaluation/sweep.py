"""Evaluation of a folder of objects: plans grasps on all views, saves them, and tries them in
simulation.
"""

import contextlib
import dataclasses
import itertools
import math
from collections.abc import Generator
from pathlib import Path
from typing import Annotated

from torchgrasp.data.manifest import read_entries
from torchgrasp.data.shards import load_grasps
from torchgrasp.evaluation.protocols import Protocol, find_protocol
from torchgrasp.evaluation.summary import ProtocolResult, ViewScore
from torchgrasp.evaluation.views import (
    REFUSAL,
    EvaluationSpec,
    ObjectView,
    choose_rows,
    plan_view,
    try_grasp,
)
from torchgrasp.files import hold_folder, temporary_folder
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import DatasetError, Status, one_line
from torchgrasp.foundation.jobs import run_tasks
from torchgrasp.foundation.rules import Range
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import check_as_loaded

# limits of the CPU time [s] of planning on a view and of an attempt; see `run_tasks`
PLAN_LIMIT = 900.0
TRIAL_LIMIT = 120.0


@checked
def evaluate(
    objects: Path,
    hand: Hand,
    protocol: Protocol | str = "dexgraspbench",
    spec: EvaluationSpec | None = None,
    *,
    folder: Path | None = None,
    workers: Annotated[int, Range(0, 1024)] = 0,
) -> Generator[ViewScore, None, None]:
    """Plan grasps on every view of a folder of objects, and try them in simulation. Yield a score
    for each view.

    The planner sees only the clouds; only the simulator uses the true meshes. The `protocol` says
    when a trial passes. An object with bad files or a bad entry gives a score with a `refusal`.
    Scores of objects with a bad entry come first. Nothing is planned before the first score is
    asked for.

    Args:
        objects: folder of objects with its manifest, as `write_objects` makes it.
        hand: the hand that grasps, as `load_hand` returns it.
        protocol: a protocol, or its name in `PROTOCOLS`.
        spec: which views and grasps are tried; None means `EvaluationSpec()`.
        folder: folder in which the executable grasps of each view, those that passed all checks,
            are saved as OBJECT/VIEW.safetensors. None means a temporary folder. No other run may
            write to it at the same time.
        workers: number of worker processes. 0 means this process, without time limits. The scores
            do not depend on it, with two exceptions. CPU times vary, and a task that reaches a
            limit of CPU time ends with the status `TIMED_OUT`. The number of such tasks, which
            `summarise` counts, depends on the speed of the machine.

    Raises:
        BadArgument: the protocol is unknown, or the hand has other numbers than its files.
        DatasetError: the manifest is missing or malformed, has no objects, or lacks an object of
            `EvaluationSpec.only`.
        OutputError: another run holds the folder, or it cannot be written.
        MissingExtra: the simulator is not installed, or pebble for workers.
        NoWorkers: no worker process can start.

    `BadArgument` and `DatasetError` are raised at the call, the others while scores are drawn.

    >>> import tempfile
    >>> from torchgrasp import load_hand, load_object
    >>> from torchgrasp.data import write_objects
    >>> folder = Path(tempfile.mkdtemp())
    >>> _ = load_object("cylinder").mesh.export(folder / "tin.ply")
    >>> _ = write_objects(folder, folder / "objects", views=1)
    >>> spec = EvaluationSpec(1, starts=10)
    >>> scores = evaluate(folder / "objects", load_hand("barrett"), "dexgraspbench", spec)
    >>> [score.executable > 0 for score in scores]
    [True]
    """
    protocol = find_protocol(protocol)
    check_as_loaded(hand)  # each task reads the files
    spec = EvaluationSpec() if spec is None else spec
    views = []
    refused = []
    for name, entry in read_entries(objects, spec.only).items():
        if isinstance(entry, DatasetError):
            note = one_line(entry)
            bad = ViewScore(ascii(name), "", 0, math.nan, refusal=Status.BAD_OBJECT, note=note)
            refused.append(bad)
        else:
            names = entry.list_views(spec.complete, spec.views)
            views += [ObjectView(Path(objects), name, view, hand.source) for view in names]
    return _evaluate(views, refused, protocol, spec, folder, workers)


def _evaluate(
    views: list[ObjectView],
    bad: list[ViewScore],
    protocol: Protocol,
    spec: EvaluationSpec,
    folder: Path | None,
    workers: int,
) -> Generator[ViewScore, None, None]:
    """Plan on and try all views, and yield their scores; `evaluate` has checked the arguments."""
    yield from bad
    with contextlib.ExitStack() as stack:
        shelf = stack.enter_context(temporary_folder()) if folder is None else Path(folder)
        if folder is not None and not spec.planned:  # grasps that are only read need no lock
            stack.enter_context(hold_folder(shelf))
        tasks = [(view, shelf, protocol, spec) for view in views]
        scores: list[ViewScore] = []
        for view, plan in zip(views, run_tasks(_plan, tasks, workers, PLAN_LIMIT), strict=True):
            if isinstance(plan, Status):
                plan = dataclasses.replace(view.score, seconds=math.nan, refusal=plan)
            scores.append(plan)
        # Every attempt is a task: one that hangs costs its view no other.
        rows = [choose_rows(score.executable, spec.grasps, spec.ranks) for score in scores]
        places = [list(itertools.product(chosen, range(protocol.noise.draws))) for chosen in rows]
        tries = [(*task, *at) for task, some in zip(tasks, places, strict=True) for at in some]
        with contextlib.closing(run_tasks(_try, tries, workers, TRIAL_LIMIT)) as results:
            for score, some in zip(scores, places, strict=True):
                attempts = list[ProtocolResult]()
                for at in some:
                    found = next(results)
                    lost = isinstance(found, Status)
                    attempts.append(ProtocolResult(*at, False, found) if lost else found)
                yield dataclasses.replace(score, attempts=tuple(attempts))


def _plan(view: ObjectView, shelf: Path, protocol: Protocol, spec: EvaluationSpec) -> ViewScore:
    """Plan grasps on a view and save them in the folder `shelf`. If an earlier call saved them,
    count them instead.
    """
    found = plan_view(view, protocol, spec, view.file(shelf) if spec.planned else None)
    if found.grasps is not None and not spec.planned:
        meta = found.grasps.meta | {REFUSAL: found.score.refusal.name}
        dataclasses.replace(found.grasps, meta=meta).save(view.file(shelf))
    return found.score


def _try(
    view: ObjectView, shelf: Path, protocol: Protocol, spec: EvaluationSpec, row: int, draw: int
) -> ProtocolResult:
    """Try the saved grasp with index `row` of a view in simulation, with the pose error of number
    `draw`.
    """
    return try_grasp(view, load_grasps(view.file(shelf)), protocol, spec, (row, draw))
