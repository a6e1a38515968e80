"""Campaigns: workers plan on every view, keep the grasps as files, then put every grasp to a protocol."""

import contextlib
import dataclasses
import functools
import itertools
import math
import time
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import torch

from torchgrasp.base import Value, count_status
from torchgrasp.border import Count, Range, Seed, checked
from torchgrasp.datasets import list_objects, list_views, read_entry, read_object_mesh, read_view
from torchgrasp.errors import BadArgument, DatasetError, GraspError, MissingExtra, OutputError, Status
from torchgrasp.evaluation.closing import GraspTrial
from torchgrasp.evaluation.perturb import find_perturbation, household_mass, perturb_trial, perturb_view
from torchgrasp.evaluation.protocols import Protocol, draw_error, find_protocol, seed_of
from torchgrasp.evaluation.pull import run_protocol
from torchgrasp.evaluation.score import ProtocolResult, ViewScore
from torchgrasp.files import hold_folder, temporary_folder
from torchgrasp.hand.hand import Hand, HandSource
from torchgrasp.hand.hand_toml import Fingers
from torchgrasp.hand.load import hand_of, load_hand
from torchgrasp.pipeline.grasps import plan_grasps
from torchgrasp.pipeline.pool import run_tasks
from torchgrasp.pipeline.provenance import digest
from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.specs import ContactSpec
from torchgrasp.values import load_grasps

if TYPE_CHECKING:
    import trimesh

MOST_FRICTION = 1.0
"""Largest friction that grasps are planned for: MultiDex grants 3, more than fingertips have."""
PLAN_LIMIT, TRIAL_LIMIT = 900.0, 120.0
"""Wall time [s] after which planning on a view, and an attempt, are ended: many times the usual."""

REFUSAL = "refusal"
"""Where the file of a view's executable grasps keeps why there are none: a later call that tries them says it, too."""

Ranks = Literal["best", "spread"]
"""Which of a view's grasps are tried: the best, or as many spread from the best to the worst."""


@checked
@dataclasses.dataclass(frozen=True)
class EvaluationSpec(Value):
    """Which grasps of a folder of objects are evaluated: of each view at most `grasps`, by `ranks`.

    `complete` plans on whole clouds with normals, as if the shape were known. `only` names objects; (): all. `planned`
    takes the grasps that an earlier call left in its folder. `starts` are those of the contact planner. `perturb` names
    what the robot does not know (`PERTURBATIONS`). At most `views` of each object are taken; None: all. `fingers` grasp
    as in `plan_grasps`: "auto" takes the likeliest set for each view; None: the hand's own.

    Raises:
        BadArgument: no grasps, unknown ranks, or an unknown perturbation.
    """

    grasps: Count = 20
    ranks: Ranks = "best"
    starts: Count = 1000
    complete: bool = False
    only: tuple[str, ...] = ()
    planned: bool = False
    seed: Seed = 0
    perturb: str = "none"
    views: Count | None = None
    fingers: Fingers | None = None

    def __post_init__(self) -> None:
        find_perturbation(self.perturb)

    @property
    def tried(self) -> str:
        """Return in words which grasps are tried.

        >>> EvaluationSpec(20).tried, EvaluationSpec(6, "spread").tried
        ('the 20 best of each view', 'up to 6 of each view, spread over all ranks')
        """
        if self.ranks == "spread":
            return f"up to {self.grasps} of each view, spread over all ranks"
        return f"the {self.grasps} best of each view" if self.grasps > 1 else "the best of each view"


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
    """Plan on every view of a folder of objects, and yield each view's score.

    Only the simulator knows the true mesh. An object with bad files or a bad entry is refused; the others go on.

    Args:
        objects: a folder as in `torchgrasp.datasets`.
        protocol: itself, or its name in `PROTOCOLS`.
        spec: which grasps; None: `EvaluationSpec()`.
        folder: where the executable grasps of each view are kept, OBJECT/VIEW.safetensors; None: nowhere. No other
            run may write it meanwhile.
        workers: processes (`run_tasks`); the scores do not depend on their number.

    Raises:
        BadArgument: an unknown protocol, no objects, or a perturbation of a protocol that pulls.
        OutputError: another run holds the folder, or it cannot be written.
        MissingExtra: the simulator, or pebble for workers, is not installed.

    >>> import tempfile
    >>> from torchgrasp import load_hand, load_object
    >>> from torchgrasp.datasets import write_objects
    >>> folder = Path(tempfile.mkdtemp())
    >>> _ = load_object("cylinder").mesh.export(folder / "tin.ply")
    >>> _ = write_objects(folder, folder / "objects", views=1)
    >>> scores = evaluate(folder / "objects", load_hand("barrett"), "tabletop", EvaluationSpec(1, starts=10))
    >>> [score.executable > 0 for score in scores]
    [True]
    """
    protocol, spec = find_protocol(protocol), EvaluationSpec() if spec is None else spec
    if spec.perturb != "none" and protocol.pull is not None:
        raise BadArgument("perturb", f"{spec.perturb!r} with {protocol.name!r}", "a protocol that lifts")
    views, refused = [], []
    for name in list_objects(objects, spec.only):
        try:
            found = list_views(objects, spec.complete, [name], spec.views)
        except DatasetError as error:
            note = " ".join(str(error).split())
            refused.append(ViewScore(ascii(name), "", 0, math.nan, refusal=Status.BAD_OBJECT, note=note))
        else:
            views += [_View(Path(objects), *x, hand.source) for x in found]
    return _evaluate(views, refused, protocol, spec, folder, workers)


def _evaluate(
    views: "list[_View]",
    refused: list[ViewScore],
    protocol: Protocol,
    spec: EvaluationSpec,
    folder: Path | None,
    workers: int,
) -> Generator[ViewScore, None, None]:
    """Yield the scores, lazily; `evaluate` checks at once."""
    yield from refused
    with _shelf(folder, spec.planned) as shelf:
        views = [dataclasses.replace(view, shelf=shelf) for view in views]
        plans = run_tasks(_plan, [(view, protocol.trial.friction, spec) for view in views], workers, PLAN_LIMIT)
        scores = [
            dataclasses.replace(view.score, seconds=math.nan, refusal=plan) if isinstance(plan, Status) else plan
            for view, plan in zip(views, plans, strict=True)
        ]
        rows = [choose_rows(score.executable, spec.grasps, spec.ranks) for score in scores]
        places = [list(itertools.product(chosen, range(protocol.noise.draws))) for chosen in rows]
        tasks = [(view, protocol, spec, *at) for view, some in zip(views, places, strict=True) for at in some]
        with contextlib.closing(run_tasks(_try, tasks, workers, TRIAL_LIMIT)) as results:
            for score, some in zip(scores, places, strict=True):
                tried = [(at, next(results)) for at in some]
                attempts = (ProtocolResult(*at, False, x) if isinstance(x, Status) else x for at, x in tried)
                yield dataclasses.replace(score, attempts=tuple(attempts))


@contextlib.contextmanager
def _shelf(folder: Path | None, planned: bool) -> Iterator[Path]:
    """Hold the folder of grasps; those of an earlier call are only read."""
    if folder is None:
        with temporary_folder() as temporary:
            yield temporary
    elif planned:
        yield Path(folder)
    else:
        with hold_folder(Path(folder)):
            yield Path(folder)


def choose_rows(executable: int, most: int, ranks: Ranks) -> list[int]:
    """Return the rows of a view's executable grasps that are tried.

    >>> choose_rows(100, 5, "best"), choose_rows(100, 5, "spread"), choose_rows(3, 5, "spread")
    ([0, 1, 2, 3, 4], [0, 25, 50, 74, 99], [0, 1, 2])
    """
    most = min(most, executable)
    if ranks == "best" or most < 2:
        return list(range(most))
    return [round(k * (executable - 1) / (most - 1)) for k in range(most)]


@dataclasses.dataclass(frozen=True)
class _View:
    """A view and a hand by their files; `shelf` is the folder of grasps."""

    objects: Path
    object: str
    view: str
    hand: HandSource
    shelf: Path = Path()

    @property
    def file(self) -> Path:
        return self.shelf / self.object / f"{self.view}.safetensors"

    @property
    def score(self) -> ViewScore:
        entry = read_entry(self.objects, self.object)
        return ViewScore(self.object, self.view, 0, 0.0, family=entry.family, group=entry.group)

    def load_hand(self) -> Hand:
        return load_hand(self.hand.urdf_path.parent, self.hand.option)


def _plan(view: _View, friction: float, spec: EvaluationSpec) -> ViewScore:
    """Plan on a view, or count the grasps of an earlier call; without any, name the commonest failure."""
    torch.set_num_threads(1)
    hand, score = view.load_hand(), view.score
    started = time.process_time()
    try:
        _read_solid(view.objects, view.object)  # a bad mesh is refused before any work; its parts are cached
        cloud, table = perturb_view(
            read_view(view.objects, view.object, view.view),
            find_perturbation(spec.perturb),
            seed_of(spec.seed, view.object, view.view),
        )
        if spec.planned:
            grasps = load_grasps(view.file)
            if (grasps.meta.get("cloud_sha256"), grasps.meta.get("hand_sha256")) != (digest(cloud), hand.source.sha256):
                raise BadArgument("folder", f"{view.file} of another cloud or hand", "grasps of this view")
            fingers = grasps.meta.get("finger_names", "")
            told = Status.__members__.get(grasps.meta.get(REFUSAL, ""), Status.OUT_OF_REACH)
            refusal = Status.OK if len(grasps) else told
            return dataclasses.replace(score, executable=len(grasps), refusal=refusal, fingers=fingers)
        started = time.process_time()
        contacts = ContactSpec(friction=min(friction, MOST_FRICTION), table=table)
        stages: list[tuple[str, str, Any]] = []
        grasps = plan_grasps(
            cloud, hand, contacts, spec.starts, spec.seed, fingers=spec.fingers, observer=lambda *x: stages.append(x)
        )
        executable = grasps[grasps.status == Status.OK]
        starts = next(value.status for name, _, value in stages if name == "plan")
        failed = count_status(grasps.status if len(grasps) else starts[starts != Status.OK])
        refusal = Status.OK if len(executable) else next(iter(failed), Status.OUT_OF_REACH)
        dataclasses.replace(executable, meta=grasps.meta | {REFUSAL: refusal.name}).save(view.file)
        fingers = grasps.meta["finger_names"]
        score = dataclasses.replace(score, executable=len(executable), refusal=refusal, fingers=fingers)
    except (MissingExtra, OutputError):  # a full disk is no fault of the object
        raise
    except GraspError as error:
        score = dataclasses.replace(score, refusal=Status.BAD_OBJECT, note=" ".join(str(error).split()))
    return dataclasses.replace(score, seconds=time.process_time() - started)


def _try(view: _View, protocol: Protocol, spec: EvaluationSpec, row: int, draw: int) -> ProtocolResult:
    """Try one grasp with one draw of what the robot does not know."""
    grasp = load_grasps(view.file)[row]
    hand = hand_of(grasp, view.load_hand())
    mesh, parts = _read_solid(view.objects, view.object)
    seed = seed_of(spec.seed, view.object, view.view, row, draw)
    perturbation = find_perturbation(spec.perturb)
    mass = household_mass(float(mesh.volume), read_entry(view.objects, view.object).mass)
    trial = perturb_trial(protocol.trial, perturbation, mass, seed)
    noise = protocol.noise if spec.perturb == "none" else perturbation.pose
    protocol = dataclasses.replace(protocol, trial=trial, noise=noise)
    error = draw_error(protocol, grasp, mesh, seed)
    attempt = GraspTrial(hand, grasp, mesh, seed_of(seed, "touch"), error, parts=parts)
    return dataclasses.replace(run_protocol(attempt, protocol, row, draw), predicted=float(grasp.success[0]))


@functools.lru_cache(maxsize=2)
def _read_solid(objects: Path, name: str) -> "tuple[trimesh.Trimesh, list[trimesh.Trimesh]]":
    """Return mesh and convex parts, kept for the next trial."""
    mesh = read_object_mesh(objects, name)
    return mesh, convex_parts(mesh)
