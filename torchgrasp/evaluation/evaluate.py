"""How many of the library's grasps pass a protocol, each planned on what one camera saw.

Two rounds of tasks for worker processes (`run_tasks`): each view is planned on, then each grasp is tried. Between them
the grasps lie as files in a folder, so that they can be kept, exported, and put to another test.
"""

import contextlib
import dataclasses
import functools
import math
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import torch

from torchgrasp.base import count_status
from torchgrasp.datasets import list_views, read_object_mesh, read_view
from torchgrasp.errors import BadArgument, GraspError, MissingExtra, Status
from torchgrasp.evaluation.pool import run_tasks
from torchgrasp.evaluation.protocols import Execution, Protocol, ProtocolResult, draw_error, find_protocol, run_protocol
from torchgrasp.evaluation.score import ViewScore
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import load_hand
from torchgrasp.pipeline import digest, plan_grasps
from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.specs import ContactSpec
from torchgrasp.values import ContactPlan, Grasps, load_grasps

if TYPE_CHECKING:
    import trimesh

MOST_FRICTION = 1.0
"""The most friction that grasps are planned for, however much a protocol grants."""

PLAN_LIMIT, TRIAL_LIMIT = 900.0, 120.0
"""Wall time [s] that planning on a view, and trying a grasp, may take before it is ended."""

Ranks = Literal["best", "spread"]
"""Which of a view's grasps are tried: the best, or as many evenly spread over all ranks, the best one included."""


def evaluate(
    objects: Path,
    hand: Hand,
    protocol: Protocol | str = "dexgraspbench",
    execution: Execution | None = None,
    grasps: int = 20,
    starts: int = 1000,
    seed: int = 0,
    *,
    ranks: Ranks = "best",
    complete: bool = False,
    only: Sequence[str] = (),
    workers: int = 0,
    folder: Path | None = None,
    planned: bool = False,
    observer: Callable[[ViewScore], None] | None = None,
) -> list[ViewScore]:
    """Plan on every view of every object of a folder, and put grasps of each to the test.

    The planner sees the noisy cloud, the camera's position, the friction and, as the objects stand on it, the height of
    the table; the true mesh is the simulator's alone. An object whose files are bad is refused and the others go on.

    Args:
        objects: folder with manifest.json, and for each object mesh.ply and noisy views.
        hand: the hand.
        protocol: one of `PROTOCOLS` by name, or another.
        execution: with what force and controller; None: the protocol's own.
        grasps: the most that are tried of each view.
        starts: of the contact planner.
        seed: of every random draw.
        ranks: which of a view's grasps are tried.
        complete: plan on the whole cloud with its normals instead: what a perfect shape is worth.
        only: names of objects to keep; by default all.
        workers: processes, see `run_tasks`; results do not depend on it.
        folder: where the executable grasps of each view are kept, OBJECT_VIEW.safetensors; by default they are not.
        planned: whether they lie there already, planned by an earlier call.
        observer: called with each score as it is there.

    Raises:
        BadArgument: an unknown protocol or closing, a force or count outside its range, or no objects.
        MissingExtra: the simulator, or with workers pebble, is not installed.
    """
    execution = Execution() if execution is None else execution
    protocol = find_protocol(protocol, execution)
    if grasps < 1:
        raise BadArgument("grasps", grasps, "at least 1")
    if ranks not in get_args(Ranks):
        raise BadArgument("ranks", repr(ranks), f"one of {', '.join(get_args(Ranks))}")
    views = [_View(Path(objects), name, view) for name, view in list_views(objects, complete, only)]
    robot, scores = str(hand.urdf_path.parent), []
    with tempfile.TemporaryDirectory() as temporary:
        shelf = Path(temporary) if folder is None else Path(folder)
        planning = [(view, robot, protocol.friction, starts, seed, shelf, planned) for view in views]
        plans = [_given(plan) for plan in run_tasks(_plan, planning, workers, PLAN_LIMIT)]
        rows = [choose_rows(plan.executable, grasps, ranks) for plan in plans]
        trying = [
            (view, robot, shelf, protocol, execution, seed, row, draw)
            for view, chosen in zip(views, rows, strict=True)
            for row in chosen
            for draw in range(protocol.draws)
        ]
        with contextlib.closing(run_tasks(_try, trying, workers, TRIAL_LIMIT)) as results:
            for view, plan, chosen in zip(views, plans, rows, strict=True):
                places = [(row, draw) for row in chosen for draw in range(protocol.draws)]
                attempts = tuple(_tried(next(results), *place) for place in places)
                scores.append(dataclasses.replace(plan, object=view.object, view=view.view, attempts=attempts))
                if observer:
                    observer(scores[-1])
    return scores


def choose_rows(executable: int, most: int, ranks: Ranks) -> list[int]:
    """Return which rows of a view's executable grasps are tried, in the order of their rank.

    >>> choose_rows(100, 5, "best"), choose_rows(100, 5, "spread"), choose_rows(3, 5, "spread")
    ([0, 1, 2, 3, 4], [0, 25, 50, 74, 99], [0, 1, 2])
    """
    most = min(most, executable)
    if ranks == "best" or most < 2:
        return list(range(most))
    return [round(k * (executable - 1) / (most - 1)) for k in range(most)]


# -------------------------------------------------------------------------------------------- what a worker does


@dataclasses.dataclass(frozen=True)
class _View:
    """A view by the names of its files."""

    objects: Path
    object: str
    view: str

    def file(self, shelf: Path) -> Path:
        """Return where its grasps are kept."""
        return shelf / f"{self.object}_{self.view}.safetensors"


def _plan(view: _View, robot: str, friction: float, starts: int, seed: int, shelf: Path, planned: bool) -> ViewScore:
    """Plan on a view and keep the executable grasps, or look at those that are kept."""
    torch.set_num_threads(1)
    hand, found = load_hand(robot), ViewScore(view.object, view.view, 0, 0.0)
    began = time.process_time()
    try:
        _solid(view.objects, view.object)  # a bad mesh is refused before any work; its parts are cached for the trials
        cloud = read_view(view.objects, view.object, view.view)
        if planned:
            grasps = load_grasps(view.file(shelf))
            if (grasps.meta.get("cloud_sha256"), grasps.meta.get("hand_sha256")) != (digest(cloud), hand.source.sha256):
                raise BadArgument("folder", f"{view.file(shelf)} of another cloud or hand", "grasps of this view")
            return dataclasses.replace(found, executable=len(grasps))
        began = time.process_time()
        spec = ContactSpec(friction=min(friction, MOST_FRICTION), table=0.0)
        stages: dict[str, Any] = {}
        grasps = plan_grasps(
            cloud, hand, spec, starts, seed, observer=lambda stage, _, value: stages.update({stage: value})
        )
        executable = grasps[grasps.status == Status.OK]
        executable.save(view.file(shelf))
        refusal = Status.OK if len(executable) else _commonest(grasps, stages["plan"])
        found = dataclasses.replace(found, executable=len(executable), refusal=refusal)
    except MissingExtra:
        raise
    except GraspError as error:
        found = dataclasses.replace(found, refusal=Status.BAD_OBJECT, note=" ".join(str(error).split()))
    return dataclasses.replace(found, seconds=time.process_time() - began)


def _commonest(grasps: Grasps, plan: ContactPlan) -> Status:
    """Return why most postures failed, or, where contacts came to no posture, most starts of the planner."""
    if len(grasps):
        counts = count_status(grasps.status)
    else:
        counts = {s: n for s, n in count_status(plan.status).items() if s is not Status.OK}
    return max(counts, key=lambda status: counts[status], default=Status.OUT_OF_REACH)


def _try(
    view: _View, robot: str, shelf: Path, protocol: Protocol, execution: Execution, seed: int, row: int, draw: int
) -> ProtocolResult:
    """Try one grasp with one drawn error of the hand's pose."""
    hand, grasps = load_hand(robot), load_grasps(view.file(shelf))
    mesh, parts = _solid(view.objects, view.object)
    error = draw_error(protocol, grasps[row], mesh, row, draw, seed)
    attempt = run_protocol(grasps[row], hand, mesh, parts, protocol, execution, seed, error=error)
    return dataclasses.replace(attempt, rank=row, draw=draw)


@functools.lru_cache(maxsize=2)
def _solid(objects: Path, name: str) -> "tuple[trimesh.Trimesh, list[trimesh.Trimesh]]":
    """Return an object's mesh and its convex parts: trials of one object follow each other."""
    mesh = read_object_mesh(objects, name)
    return mesh, convex_parts(mesh)


def _given(plan: ViewScore | Status) -> ViewScore:
    """Return what planning gave, if its process came to no end too."""
    return ViewScore("", "", 0, math.nan, refusal=plan) if isinstance(plan, Status) else plan


def _tried(attempt: ProtocolResult | Status, row: int, draw: int) -> ProtocolResult:
    """Return what an attempt gave, if its process came to no end too."""
    lost = dict.fromkeys(("moved", "turned", "force", "overlap", "seconds"), math.nan)
    return ProtocolResult(row, draw, False, attempt, **lost) if isinstance(attempt, Status) else attempt
