"""A campaign on a folder of objects: from views to a data set of grasps on disk.

A job plans and tries the grasps of one view of one object.
"""

import dataclasses
import hashlib
import itertools
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from torchgrasp.campaign.cluster import OnGpu, run_on_cluster
from torchgrasp.campaign.folder import Campaign, carry_out
from torchgrasp.campaign.job import empty_shard, plan_jobs, run_job, versions
from torchgrasp.data.manifest import read_entries
from torchgrasp.data.reader import GraspShards
from torchgrasp.data.shards import JobRow, shard_ranges, short
from torchgrasp.evaluation.protocols import Protocol, find_protocol
from torchgrasp.evaluation.sweep import PLAN_LIMIT, TRIAL_LIMIT
from torchgrasp.evaluation.views import EvaluationSpec, ObjectView
from torchgrasp.files import format_json, sha256
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, DatasetError, Status
from torchgrasp.foundation.jobs import run_as_they_end
from torchgrasp.foundation.rules import Range
from torchgrasp.hand.hand import Hand, HandSource
from torchgrasp.hand.load import check_as_loaded

LONGEST_LICENCE = 100  # letters of a licence's name; those of the SPDX list have at most 40


@checked
@dataclasses.dataclass(frozen=True)
class CampaignSpec(Value):
    """Options of `run_campaign`: test protocol, views and grasps to try, licence, size of files,
    and device.

    Args:
        protocol: the protocol by which each grasp is tried in simulation, or its name in
            `torchgrasp.evaluation.PROTOCOLS`. An unknown name raises `BadArgument` in the property
            `test` and in `run_campaign`, not here.
        trials: which views are planned on, and how many of their grasps are tried
            (`torchgrasp.evaluation.EvaluationSpec`).
        licence: licence of the data set, preferably an SPDX identifier such as "CC-BY-4.0".
        jobs_in_shard: number of jobs in one file. A job is one view of one object.
        device: "cpu", or "cuda" to plan on a GPU, on all views of a file at once. For "cuda" the argument
            `workers` of `run_campaign` must be the address of a Dask scheduler. The workers of this
            cluster must have the resource "GPU". Grasps may differ from those of a CPU by rounding.

    Raises `BadArgument` for:

    * `trials` with `complete`, `planned` or `fingers`: a campaign plans on partial views, with the
      fingers of its hand;
    * a `licence` that is not one printable line of 1 to 100 characters;
    * a number outside its range.

    >>> CampaignSpec("dexgraspbench").test.trial.friction
    0.6
    """

    protocol: Protocol | str = "tabletop"
    trials: EvaluationSpec = dataclasses.field(default_factory=EvaluationSpec)
    licence: str = "unknown"
    jobs_in_shard: Annotated[int, Range(1, 10_000)] = 64
    device: Literal["cpu", "cuda"] = "cpu"

    def __post_init__(self) -> None:
        """Raise `BadArgument` unless trials plan on partial views with default fingers, or for a
        bad licence.
        """
        trials = self.trials
        for name in ("planned", "complete", "fingers"):
            value = getattr(trials, name)
            if value not in (False, None):
                found = f"{name} = {value!r}"
                raise BadArgument("trials", found, "views that are planned on anew")
        if not self.licence.isprintable() or not 0 < len(self.licence) <= LONGEST_LICENCE:
            allowed = f"a line of 1 to {LONGEST_LICENCE} letters"
            raise BadArgument("licence", repr(self.licence), allowed)

    @property
    def test(self) -> Protocol:
        """The `Protocol` of the campaign, also if `protocol` holds only its name.

        Raises `BadArgument` for an unknown name.
        """
        return find_protocol(self.protocol)


@checked
def run_campaign(
    objects: Path | str,
    hand: Hand,
    folder: Path | str,
    spec: CampaignSpec | None = None,
    workers: Annotated[int, Range(0, 1024)] | str = 0,
    observer: Callable[[JobRow], object] = lambda row: None,
) -> GraspShards:
    """Plan grasps on every view of a folder of objects, try them in simulation, and return the data
    set.

    The data set is written to `folder`; `read_shards` reads it again. A job is one view of one
    object. Each job gives a `JobRow` and its grasps; without grasps the row says why. A finished
    job is on disk at once.

    The same call continues an interrupted run. It also repeats the jobs whose work did not end:
    those with the status `WORKER_DIED`, `TIMED_OUT` or `BROKEN`. The files do not depend on the
    number and order of workers, nor on interruptions (docs/promises.md, N10).

    Args:
        objects: folder of objects with its manifest, as `write_objects` makes it. On a cluster it
            has the same path on every machine.
        hand: the hand as `load_hand` returns it, with the fingers that grasp.
        folder: folder of the data set. No other run may write to it at the same time.
        spec: options of the campaign; None means `CampaignSpec()`.
        workers: number of processes on this machine; 0 means this process. Or the address of a Dask
            scheduler, such as "tcp://10.0.0.1:8786", whose workers have one thread each.
        observer: function that is called with the `JobRow` of each finished job.

    Raises:
        DatasetError: the manifest is missing or malformed, has no objects, or lacks an object of
            `EvaluationSpec.only`.
        BadArgument: an unknown protocol, or no Dask scheduler at the address `workers`.
        BadArgument: `spec.device` is "cuda", but `workers` is not the address of a Dask scheduler.
        BadArgument: a machine of the cluster has other versions or another hand.
        BadArgument: the hand has other numbers than its files.
        OutputError: the folder holds another campaign, such as one of other meshes or clouds, or
            other files; another run uses it, or it cannot be written.
        MissingExtra: the simulator, pebble for workers, or Dask for a cluster is not installed.

    >>> import tempfile, trimesh
    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data import write_objects
    >>> from torchgrasp.evaluation import EvaluationSpec
    >>> meshes = Path(tempfile.mkdtemp())
    >>> _ = trimesh.creation.cylinder(radius=0.03, height=0.12).export(meshes / "tin.stl")
    >>> _ = write_objects(meshes, meshes / "objects", views=1)
    >>> spec = CampaignSpec("dexgraspbench", EvaluationSpec(1, starts=8))
    >>> data = run_campaign(meshes / "objects", load_hand("barrett"), meshes / "data", spec)
    >>> [(row.object, row.status.name) for row in data.jobs], len(data)
    ([('tin', 'OK')], 1)
    """
    spec = CampaignSpec() if spec is None else spec
    if spec.device != "cpu" and not isinstance(workers, str):
        raise BadArgument("workers", workers, "a Dask scheduler, whose workers have the GPUs")
    test = spec.test
    check_as_loaded(hand)  # each job reads the files
    place = Path(objects).resolve()
    rows = _list_jobs(place, spec)
    asked = _request(place, rows, hand, spec)
    campaign = Campaign(asked, rows, lambda row: empty_shard(row, hand, test.noise.draws))
    source = HandSource(hand.source.option, hand.source.urdf_path, hand.source.sha256)
    views = [ObjectView(place, row.object, row.view, source) for row in rows]
    shards = shard_ranges(len(rows), spec.jobs_in_shard)
    limit = PLAN_LIMIT + TRIAL_LIMIT * spec.trials.grasps * test.noise.draws

    def work(numbers: Sequence[int]) -> Generator[tuple[int, bytes | Status], None, None]:
        if isinstance(workers, str):
            return run_on_cluster(run_job, tasks(numbers), workers, limit)
        return run_as_they_end(run_job, tasks(numbers), workers, limit)

    def tasks(numbers: Sequence[int]) -> Iterator[tuple[Any, ...]]:
        meta = campaign.meta
        for k, own in itertools.groupby(numbers, lambda j: j // spec.jobs_in_shard):
            shard = [j for j in shards[k] if rows[j].status is Status.OK]
            plan = None
            if spec.device != "cpu":  # a shard has one plan, whichever of its jobs are left
                of_shard = [views[j] for j in shard]
                plan = OnGpu(plan_jobs, (meta, of_shard, test, spec.trials, spec.device))
            for j in own:
                yield views[j], test, spec.trials, meta, plan, shard.index(j)

    return carry_out(campaign, Path(folder), work, observer)


def _request(
    objects: Path, rows: Sequence[JobRow], hand: Hand, spec: CampaignSpec
) -> dict[str, Any]:
    """Return the request of a campaign, the content of `campaign.json`."""
    of_hand = {
        "name": hand.name,
        "option": hand.source.option,
        "sha256": hand.source.sha256,
        "joint_names": ", ".join(hand.joint_names),
        "finger_names": ", ".join(hand.finger_names),
    }
    return {
        "torchgrasp": "campaign",
        "version": 1,
        "licence": spec.licence,
        "objects_sha256": _digest(objects, rows),
        "hand": of_hand,
        "protocol": dataclasses.asdict(spec.test),
        "trials": dataclasses.asdict(spec.trials),
        "jobs_in_shard": spec.jobs_in_shard,
        "versions": versions(),
        "device": spec.device,
    }


def _digest(objects: Path, rows: Sequence[JobRow]) -> str:
    """Return the SHA-256 of the manifest, meshes and clouds of all jobs: other files are another
    campaign.
    """
    names = ["manifest.json"]
    for row in rows:
        if row.status is Status.OK:
            names += [f"{row.object}/mesh.ply", f"{row.object}/{row.view}_noisy.ply"]
    paths = {name: objects / name for name in dict.fromkeys(names)}
    found = {name: sha256(x) if x.is_file() else "missing" for name, x in paths.items()}
    return hashlib.sha256(format_json(found).encode()).hexdigest()


def _list_jobs(objects: Path, spec: CampaignSpec) -> tuple[JobRow, ...]:
    """Return one row for each job (a view of an object), in order. An object with a bad entry gives
    a single row.
    """
    rows: list[JobRow] = []
    for name, entry in read_entries(objects, spec.trials.only).items():
        if isinstance(entry, DatasetError):
            rows.append(JobRow(short(ascii(name)), "", Status.BAD_OBJECT, short(str(entry))))
        else:
            of_object = JobRow(name, "", family=entry.family, group=entry.group)
            names = entry.list_views(most=spec.trials.views)
            rows += [of_object._replace(view=view) for view in names]
            if not names:
                note = "the manifest names no view"
                rows.append(of_object._replace(status=Status.BAD_OBJECT, note=note))
    return tuple(rows)
