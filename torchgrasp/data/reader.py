"""Reader of a campaign's data set, grasp by grasp for learning, or job by job."""

import bisect
import dataclasses
import functools
import itertools
import operator
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchgrasp.data.shards import MOST, JobRow, Shard, load_shard, read_row, shard_ranges
from torchgrasp.files import Recent, read_json
from torchgrasp.foundation.base import map_tensors
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import ModelFileError
from torchgrasp.foundation.rules import Count, Range
from torchgrasp.values.planning import Grasps, PointCloud

# file that describes a data set; it is written last, so a folder with a card is complete
CARD = "card.json"
CARD_BYTES = 256 * 1024**2  # largest card


class ShardJob(NamedTuple):
    """One job of a data set: one view of one object, with the g grasps that were planned on it.

    `GraspShards.job` returns it. Each grasp was tried d times in simulation.

    Attributes:
        row: names, status and counts of the job.
        cloud: the cloud [m] of the view; None if no view was read.
        grasps: the grasps, in the frame of the cloud.
        passed: whether each trial of each grasp passed, by the protocol of the campaign, a mask (g,
            d).
        outcome: the `Status` of each trial of each grasp, integers (g, d).
    """

    row: JobRow
    cloud: PointCloud | None
    grasps: Grasps
    passed: Bool[Tensor, "g d"]
    outcome: Int[Tensor, "g d"]


@dataclasses.dataclass(frozen=True)
class GraspShards:
    """A data set of grasps on disk, for `torch.utils.data.DataLoader`; `read_shards` opens it.

    `len(data)` is the number of grasps. `data[i]` is a dict of tensors for grasp i. Numbers are
    float32, in the object's frame. n counts points, h actuated joints, and f fingertips:

    * `points` (n, 3) [m] and `viewpoint` (3,) [m] of the cloud; the viewpoint is 0 if unknown.
    * `joints` (h,) of the grasp and `pregrasp` (h,) of the opened hand [rad or m].
    * `approach` (3,), the unit direction of the approach, and the pose `obj_from_hand` (4, 4) [m].
    * `contacts` (f, 3) [m], and the outward unit `normals` (f, 3) of the surface there.
    * `std_m` (f,) [m], the standard deviation of the surface at each contact.
    * `margin`, a number: the margin of the contacts' force closure, positive if they have it.
    * `witness` (6,), a unit wrench that proves the margin (`Certificate`).
    * `clearance` [m], the least distance of links from surface, table and each other (`Grasps`).
    * `predicted`, the predicted success in [0, 1]; NaN where no trial supports it.
    * `simulated`, the share in [0, 1] of the grasp's simulated trials that passed, by the protocol
      of the campaign.
    * `closed`, a boolean: whether the contacts have frictional form closure (`certify`), so that
      they can resist any load.
    * `job`, an integer: the index in `jobs` of the grasp's view.

    An index out of range raises `IndexError`, and a damaged file `ModelFileError`.

    Attributes:
        folder: folder of the data set.
        card: content of `card.json`: "licence", "asked" (the settings of the campaign), "counts",
            "jobs" and others.
        jobs: the outcome of each job, one view of one object, with or without grasps.
        size: number of jobs in a shard, a file of the data set.
        points: number of points of each item's cloud. None means all points, so that clouds may
            differ in size.
        recent: the cache of the shards that were read last.
    """

    folder: Path
    card: dict[str, Any]
    jobs: tuple[JobRow, ...]
    size: int
    points: int | None = None
    recent: Recent[Any] = dataclasses.field(
        default_factory=lambda: Recent[Any](32), repr=False, compare=False
    )

    @functools.cached_property
    def starts(self) -> list[int]:
        """For each job the index of its first grasp in the data set; then the number of all grasps.

        The grasps of job j are `data[starts[j]]` to `data[starts[j + 1] - 1]`.
        """
        return list(itertools.accumulate((row.grasps for row in self.jobs), initial=0))

    def __len__(self) -> int:
        return self.starts[-1]

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, i: int) -> dict[str, Tensor]:
        """Return grasp i of the data set, with its cloud, as a dict of tensors by name.

        Raises `IndexError` for no such grasp, and `ModelFileError` if the file of its shard is
        damaged.
        """
        i = range(len(self))[operator.index(i)]
        j = bisect.bisect_right(self.starts, i) - 1
        _, records = self._take(j)
        grasps = records.grasps
        g = i - self.starts[j]
        contacts = grasps.contacts
        certificate = grasps.certificate
        names = ("joints", "pregrasp", "approach", "obj_from_hand", "clearance")
        item = {name: getattr(grasps, name)[g] for name in names}
        item |= {
            "contacts": contacts.points[g],
            "normals": contacts.normals[g],
            "std_m": contacts.require_std()[g],
            "margin": certificate.margin[g],
            "witness": certificate.witness[g],
            "predicted": grasps.success[g],
            "simulated": records.passed[g].double().mean(),
            "points": _choose(records.points, self.points, i),
            "viewpoint": records.viewpoints[0],
        }
        # copies: callers may change items in place, and the shard stays in memory
        single = {
            name: x.to(torch.float32, copy=True).as_subclass(Tensor) for name, x in item.items()
        }
        closed = certificate.closed[g].clone()
        return {**single, "closed": closed, "job": torch.tensor(j, device="cpu")}

    @checked
    def job(self, j: Annotated[int, Range(0, MOST)]) -> ShardJob:
        """Return cloud, grasps and trials of a job, one view of one object, as they are stored.

        Args:
            j: index of the job in `jobs`, from 0.

        Raises:
            IndexError: `jobs` has no such index.
            BadArgument: a negative index.
            ModelFileError: the job's file is missing, damaged, or of another campaign.
        """
        j = range(len(self.jobs))[j]
        row, kept = self._take(j)
        records = map_tensors(torch.clone, kept)  # callers may change it in place
        grasps = dataclasses.replace(records.grasps, meta=dict(row[0].meta))
        eye = records.viewpoints[0] if bool(records.viewpoints.any()) else None
        cloud = PointCloud(records.points, viewpoint=eye) if len(records.points) else None
        return ShardJob(row[0], cloud, grasps, records.passed, records.outcome)

    def _take(self, j: int) -> Shard:
        """Return a shard that holds only job j."""
        return self.recent.get(j // self.size, self._read).take(j % self.size)

    def _read(self, k: int) -> Shard:
        """Read shard k (a file of results); raise an error if its jobs are not those listed in
        `card.json`.
        """
        path = shard_path(self.folder, k)
        shard = load_shard(path, {"campaign": str(self.card["campaign"])})
        bare = tuple(row._replace(meta={}) for row in shard.rows)
        if bare != self.jobs[k * self.size : (k + 1) * self.size]:
            raise ModelFileError("path", f"{path} of other jobs", f"those of {CARD}")
        return shard


def shard_path(folder: Path, k: int) -> Path:
    """Return the path of shard `k`, a file of a data set, in the data set's folder.

    `k` counts from 0. The file need not exist.
    """
    return folder / f"shard-{k:06d}.safetensors"


@checked
def read_shards(folder: Path | str, points: Count | None = None) -> GraspShards:
    """Open a data set that `run_campaign` wrote; its files are read on demand.

    Args:
        folder: the folder that `run_campaign` wrote.
        points: number of points that are drawn from the cloud for each grasp. The draw of a grasp
            is the same each time. A cloud with fewer points repeats some. None means all points.

    Raises `ModelFileError` if the campaign is not finished, or its card is damaged.

    >>> import tempfile, trimesh
    >>> from torchgrasp import load_hand
    >>> from torchgrasp.campaign import CampaignSpec, run_campaign
    >>> from torchgrasp.data import write_objects
    >>> from torchgrasp.evaluation import EvaluationSpec
    >>> folder = Path(tempfile.mkdtemp())
    >>> _ = trimesh.creation.box((0.05, 0.06, 0.12)).export(folder / "carton.ply")
    >>> _ = write_objects(folder, folder / "objects", views=1)
    >>> spec = CampaignSpec("dexgraspbench", EvaluationSpec(1, starts=8))
    >>> _ = run_campaign(folder / "objects", load_hand("barrett"), folder / "data", spec)
    >>> data = read_shards(folder / "data", points=100)
    >>> data[0]["points"].shape, data.jobs[0].object, data.job(0).row.grasps
    (torch.Size([100, 3]), 'carton', 1)
    """
    folder = Path(folder)
    refuse = functools.partial(ModelFileError, "folder")
    allowed = "a folder that `torchgrasp campaign` finished"
    card = read_json(folder / CARD, refuse, allowed, CARD_BYTES)
    fields = card.entries("campaign", "jobs_in_shard", "jobs")
    fields["campaign"].text()
    jobs = tuple(read_row(row, bare=True) for row in fields["jobs"].items(MOST))
    size = fields["jobs_in_shard"].whole(1, MOST)
    shards = range(len(shard_ranges(len(jobs), size)))
    lacking = sum(not shard_path(folder, k).is_file() for k in shards)
    if lacking:
        found = f"{folder} without {lacking} of its shards"
        raise refuse(found, "all shards: run the campaign again")
    return GraspShards(folder, card.value, jobs, size, points)


def _choose(points: Tensor, count: int | None, seed: int) -> Tensor:
    """Draw `count` points of a cloud; None means all points."""
    if count is None:
        return points
    generator = torch.Generator("cpu").manual_seed(seed)
    # on the CPU, whatever torch's default device is
    if count <= len(points):
        return points[torch.randperm(len(points), generator=generator, device="cpu")[:count]]
    return points[torch.randint(len(points), (count,), generator=generator, device="cpu")]
