"""Trials of the predicted success: grasps of all ranks on authored household bodies. Each is tried
with a task of its own.

One job is one body and one hand. It is planned on from a noisy view and its grasps are tried in
MuJoCo. The jobs of a hand are a campaign (`torchgrasp.campaign`): the same call continues an
interrupted run. Tasks are kept as metadata.

For promises, the best grasp for each of a few ordinary tasks is tried instead. The bodies are of
families that fit no model.
"""

import dataclasses
import json
from collections.abc import Generator, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import tyro
from tqdm import tqdm

from torchgrasp import plan_grasps
from torchgrasp.campaign.cluster import run_on_cluster
from torchgrasp.campaign.folder import README, Campaign, carry_out
from torchgrasp.campaign.job import check_versions, empty_shard, versions
from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.cloud.sensor import SensorName
from torchgrasp.contacts.region import Region
from torchgrasp.data import read_entry, read_object_mesh
from torchgrasp.data.manifest import read_entries
from torchgrasp.data.reader import GraspShards
from torchgrasp.data.shards import JobRow, Records, Shard, pack_shard, short
from torchgrasp.evaluation.protocols import draw_error, seed_of
from torchgrasp.evaluation.pull import run_protocol
from torchgrasp.evaluation.trial import GraspTrial, Truth
from torchgrasp.files import sha256, write_file
from torchgrasp.foundation.errors import GraspError, Status
from torchgrasp.foundation.jobs import run_as_they_end
from torchgrasp.geometry.plane import Plane
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import load_hand
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.surface import surface_field
from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.success.body import EstimatedBody
from torchgrasp.success.features import measure_grasps
from torchgrasp.success.model import MODEL, load_success_model
from torchgrasp.success.order import is_covered
from torchgrasp.success.task import Conditions
from torchgrasp.values.planning import Grasps, PointCloud
from torchgrasp.values.specs import ContactSpec
from train.household import CALIBRATING, FAMILIES, HouseholdBody, author_household, family_of
from train.tasks import ORDINARY_FRICTION, PULL, Task, draw_friction, draw_ordinary, draw_task

HANDS = ("allegro", "barrett", "leap", "shadow")
"""Hands of the trials; each body is tried with one of them."""

CAMERAS: tuple[SensorName, ...] = ("realsense", "realsense_cloud", "kinect_v1", "azure", "zivid")
SENSORS: tuple[bool | SensorName, ...] = (True, *CAMERAS)
"""Noise of the views."""

STARTS = 400
BEST = 6
SPREAD = 6
"""Random starts of the planner; grasps tried of the twenty best ones, and of those that follow."""

TASKS = 3
"""Ordinary tasks of a body, for each of which its best grasp is tried."""

KEPT = 0.2
"""Share of the bodies whose contacts are planned in one half of their view, as at a handle."""

LIMIT = 1800.0
"""Limit [s] of the CPU time of one job."""


ABOUT = """---
license: mit
---
# Grasps of the {hand} hand on {bodies}, each tried with a task of its own

{counts[tries]} trials of {counts[objects]} bodies of {counts[families]} families; {counts[passed]} passed.
`scripts/train.py trials` makes them. A job is one noisy view of one body, planned on from {starts} starts. Tried
in MuJoCo are {which}. `read_rows` of `train/trials.py` reads jobs with their
tasks: friction, mass, force, protocol, and whether the object is elsewhere.

Made with {versions}.
"""


class Trial(NamedTuple):
    """One trial: a grasp on a body, by its rank from 0, with its task and outcome."""

    body: str
    family: str
    rank: int
    task: Task
    passed: bool
    status: Status


class Shelf(NamedTuple):
    """Objects of a folder that are tried in place of household bodies.

    The k-th body is each object in turn, once for each hand.
    """

    folder: Path
    names: tuple[str, ...]

    def read(self, k: int) -> HouseholdBody:
        """Return the k-th body with its mesh, convex parts [m] and family, read from the folder."""
        name = self.names[k // len(HANDS) % len(self.names)]
        mesh = read_object_mesh(self.folder, name)
        family = read_entry(self.folder, name).family
        return HouseholdBody(name, family, mesh, list(convex_parts(mesh)))


def trials(
    folder: tyro.conf.Positional[Path],
    bodies: int = 20 * len(FAMILIES),
    workers: int | str = 1,
    hands: tuple[str, ...] = HANDS,
    first: int = 0,
    best: bool = False,
    objects: Path | None = None,
    names: tuple[str, ...] = (),
) -> None:
    """Try grasps of all hands on household bodies; what is in the folder is not run again.

    Args:
        folder: of the data sets, one for each hand.
        bodies: number of bodies; they are shared among the hands.
        workers: number of processes, or the address of a Dask scheduler.
        hands: whose share is tried.
        first: number of the first body, so that more bodies can follow in a folder of their own.
        best: try the best grasp for ordinary tasks, on bodies of the families that calibrate the
            model.
        objects: folder of objects that are tried in place of household bodies. Each is tried with
            each hand, then all again from another side.
        names: objects of this folder; by default all.
    """
    shelf = None if objects is None else Shelf(objects, names or tuple(read_entries(objects)))
    for hand in hands:
        data = run_trials(hand, bodies, folder, workers, first=first, best=best, shelf=shelf)
        counts = data.card["counts"]
        told = f"{counts['tries']} trials on {counts['objects']} bodies"
        print(f"{hand}: {told}, {counts['passed']} passed")


def run_trials(
    hand: str,
    bodies: int,
    folder: Path,
    workers: int | str = 1,
    seed: int = 0,
    first: int = 0,
    best: bool = False,
    shelf: Shelf | None = None,
) -> GraspShards:
    """Try grasps of one hand on its share of some bodies from the `first` on, and return the data
    set. The bodies of a `shelf` take the place of household bodies.
    """
    numbers = [k for k in range(first, first + bodies) if k % len(HANDS) == HANDS.index(hand)]
    if best and shelf is None:
        numbers = [k for k in numbers if family_of(k) in CALIBRATING]
    model = load_hand(hand)
    of_hand = {"name": hand, "option": model.source.option, "sha256": model.source.sha256}
    of_hand["joint_names"] = ", ".join(model.joint_names)
    of_hand["finger_names"] = ", ".join(model.finger_names)
    trials = {"grasps": BEST + SPREAD, "ranks": "best and spread", "starts": STARTS, "seed": seed}
    if shelf is not None:
        trials |= {"objects": list(shelf.names)}
    if best:
        trials |= {"grasps": TASKS, "ranks": "best", "model_sha256": sha256(MODEL)}
    asked = {
        "torchgrasp": "campaign",
        "version": 1,
        "licence": "MIT",
        "hand": of_hand,
        "trials": trials,
        "protocol": dataclasses.asdict(PULL),
        "tasks": "drawn for each trial: train/tasks.py",
        "bodies": len(numbers),
        "jobs_in_shard": 32,
        "versions": versions(),
        "device": "cpu",
    }
    rows = tuple(JobRow(f"body{k:05d}", "view0") for k in numbers)
    campaign = Campaign(asked, rows, lambda row: empty_shard(row, model, 1))

    def work(places: Sequence[int]) -> Generator[tuple[int, bytes | Status], None, None]:
        tasks = [(hand, numbers[place], seed, campaign.meta, best, shelf) for place in places]
        run = run_on_cluster if isinstance(workers, str) else run_as_they_end
        return run(try_body, tasks, workers, LIMIT)  # pyright: ignore[reportArgumentType]

    with tqdm(total=len(rows), disable=None) as bar:
        data = carry_out(campaign, folder / hand, work, lambda _: bar.update())
    counts = data.card["counts"]
    spread = f"{BEST} of its twenty best grasps and {SPREAD} others"
    which = f"the best grasps for {TASKS} ordinary tasks" if best else spread
    tried = "household bodies" if shelf is None else "given objects"
    about = ABOUT.format(
        hand=hand,
        bodies=tried,
        counts=counts,
        versions=json.dumps(versions()),
        starts=STARTS,
        which=which,
    )
    write_file(folder / hand / README, about)
    return data


def try_body(
    hand: str,
    k: int,
    seed: int,
    meta: dict[str, str],
    best: bool = False,
    shelf: Shelf | None = None,
) -> bytes:
    """Plan on one random view of the k-th body, try its grasps, and return the bytes of a shard.

    The shard holds this job alone. `meta` is its metadata, and says which software versions this
    machine must have. `best` tries the best grasp for ordinary tasks. `shelf` replaces the
    household bodies.
    """
    check_versions(meta)
    model = load_hand(hand)
    body = author_household(k) if shelf is None else shelf.read(k)
    draw = np.random.default_rng([seed, k])
    row = JobRow(f"body{k:05d}", "view0", family=body.family)
    try:
        shard = _try_body(model, body, draw, row, seed_of(seed, k), best)
    except GraspError as error:  # as a body that the camera does not see
        row = row._replace(status=Status.BAD_OBJECT, note=short(f"{type(error).__name__}: {error}"))
        shard = empty_shard(row, model, 1)
    return pack_shard(shard, meta)


def _try_body(
    hand: Hand, body: HouseholdBody, draw: np.random.Generator, row: JobRow, seed: int, best: bool
) -> Shard:
    azimuth = draw.uniform(0.0, 360.0)
    elevation = draw.uniform(15.0, 60.0)
    sensor = SENSORS[draw.integers(len(SENSORS))]
    friction = round(float(draw.uniform(*ORDINARY_FRICTION)), 3) if best else draw_friction(draw)
    camera = look_at(azimuth, elevation, target=body.mesh)
    cloud = partial_view(body.mesh, camera, noise=sensor, seed=seed)
    table = Plane.horizontal(0.0)
    eye = cloud.viewpoint.double()[None]  # pyright: ignore[reportOptionalMemberAccess]
    kept = not best and draw.random() < KEPT
    region = draw_half(cloud, draw) if kept else None
    spec = ContactSpec(friction=friction, table=table)
    found = plan_grasps(cloud, hand, spec, STARTS, keep=region)
    executable = found.executable
    seen = {"sensor": str(sensor), "region": "half" if kept else "none"}
    row = row._replace(executable=len(executable), points=len(cloud), meta=seen)
    if not len(executable):
        why = Status(int(found.status.mode().values)) if len(found) else Status.OUT_OF_REACH
        row = row._replace(status=why)
        records = empty_shard(row, hand, 1).records
        seen_alone = dataclasses.replace(records, points=cloud.points.double(), viewpoints=eye)
        return Shard((row,), seen_alone)
    shape = fit_shape(cloud, table=table)
    if best:
        tasks = [draw_ordinary(draw, friction) for _ in range(TASKS)]
        ranks = best_for(tasks, hand, shape, executable)
    else:
        ranks = choose_ranks(len(executable), draw)
        tasks = [draw_task(draw, friction) for _ in ranks]
    surface = surface_field(shape)
    results = []
    for number, (rank, task) in enumerate(zip(ranks, tasks, strict=True)):
        grasp = executable[rank]
        own = seed_of(seed, number if best else rank)
        error = draw_error(task.protocol, grasp, body.mesh, own)
        truth = Truth(body.mesh, body.parts, error)
        known = surface if task.lift else None
        trial = GraspTrial(hand, grasp, truth, seed_of(own, "touch"), surface=known)
        results.append(run_protocol(trial, task.protocol, rank))
    passed = torch.tensor([[x.passed] for x in results])
    outcome = torch.tensor([[int(x.status)] for x in results])
    said = json.dumps([dataclasses.asdict(task) for task in tasks])
    tried = {"tasks": said, "ranks": json.dumps(ranks), "friction": str(friction)}
    meta = executable.meta | row.meta | tried
    row = row._replace(grasps=len(ranks), passed=int(passed.sum()), meta=meta)
    return Shard((row,), Records(cloud.points.double(), eye, executable[ranks], passed, outcome))


def half_of(cloud: PointCloud, axis: int, far: bool) -> Region:
    """Return one half of a cloud's bounding box, cut across an axis (0, 1 or 2), as a region.

    If `far`, it is the half of the greater coordinates. It reaches beyond the box in all other
    directions, so that it holds the unseen side of the object.
    """
    points = cloud.points.double()
    low = points.amin(0)
    high = points.amax(0)
    middle = (low + high) / 2
    deep = (high - low).max()
    low = low - deep
    high = high + deep
    (low if far else high)[axis] = middle[axis]
    return Region.box(low, high)


def draw_half(cloud: PointCloud, draw: np.random.Generator) -> Region:
    """Draw one half of a cloud's bounding box as a region: its upper one, or an end in x or y."""
    axis = int(draw.integers(3))
    return half_of(cloud, axis, axis == 2 or draw.random() < 0.5)


def best_for(tasks: Sequence[Task], hand: Hand, shape: ShapeGP, grasps: Grasps) -> list[int]:
    """Return for each task the index of the grasp with the greatest predicted success.

    Only grasps within the range of the success model count.
    """
    body = EstimatedBody.of(shape)
    best = list[int]()
    for task in tasks:
        conditions = Conditions.of(task.friction, task.known.mass)
        features = measure_grasps(hand, body, grasps, conditions, task.known, task.lift)[0]
        odds = load_success_model().log_odds(features)
        best.append(int(odds.where(is_covered(features), -torch.inf).argmax()))
    return best


def choose_ranks(executable: int, draw: np.random.Generator) -> list[int]:
    """Draw the ranks of the grasps that are tried, sorted: some of the twenty best, some others.

    There are fewer if there are not enough executable grasps.

    >>> choose_ranks(3, np.random.default_rng(0))
    [0, 1, 2]
    """
    best = np.arange(min(20, executable))
    others = np.arange(20, executable)
    few = [draw.permutation(rows)[:most] for rows, most in ((best, BEST), (others, SPREAD))]
    return sorted(int(x) for x in np.concatenate(few))


def read_rows(shards: Iterable[Shard]) -> Iterator[tuple[JobRow, PointCloud, Grasps, list[Trial]]]:
    """Yield (row, cloud, grasps, trials) of each job of some shards that has grasps.

    A job is one view of one body. Cloud [m] and grasps are in the body's frame.
    """
    for shard in shards:
        for k, row in enumerate(shard.rows):
            if not row.grasps:
                continue
            records = shard.take(k).records
            said: list[dict[str, Any]] = json.loads(row.meta["tasks"])
            ranks = json.loads(row.meta["ranks"])
            tasks = [Task(**fields) for fields in said]
            outcomes = zip(ranks, tasks, records.passed[:, 0], records.outcome[:, 0], strict=True)
            trials = [
                Trial(row.object, row.family, rank, task, bool(passed), Status(int(status)))
                for rank, task, passed, status in outcomes
            ]
            cloud = PointCloud(records.points, viewpoint=records.viewpoints[0])
            yield row, cloud, records.grasps, trials
