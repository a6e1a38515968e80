"""Files of grasps: of a plan, or a shard with the records of a campaign's jobs. A job is one object
and view.
"""

import dataclasses
import functools
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.files import Field, pack_tensors, read_value
from torchgrasp.foundation.base import FINGERTIPS, Value, map_tensors, named_tensors
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import ModelFileError, Status, one_line
from torchgrasp.foundation.limits import JSON_LETTERS
from torchgrasp.foundation.rules import is_rigid
from torchgrasp.values.planning import Grasps

KIND = "grasp-shard"  # kind of the file
MOST = 1_000_000  # most points, grasps and tries of one job
META_LETTERS = 10_000  # letters of an entry of the metadata, which may name all joints


class JobRow(NamedTuple):
    """The outcome of one job of a campaign: one view of one object.

    Attributes:
        object: name of the object.
        view: name of the view; "" if the object's entry in the manifest is malformed or names no
            view.
        status: `OK` if a grasp is executable. Else it is the most frequent failure of the plan, or
            `BAD_OBJECT` for bad files or a failed plan. It is `TIMED_OUT`, `WORKER_DIED` or
            `BROKEN` if the work on the job did not end.
        note: details of the status, or "".
        family: name of a family of similar objects, or "".
        group: group of objects, such as "solid", or "".
        executable: number of planned grasps that are executable: they passed all checks.
        points: number of points of the cloud.
        grasps: number of the executable grasps that were tried in simulation and kept.
        passed: number of simulated trials that passed, over all these grasps.
        meta: `Grasps.meta` of the plan. It is empty without a plan, and in the rows of
            `GraspShards.jobs`.

    >>> JobRow("mug", "view0", Status.NOT_CLOSED, points=1000).as_json()["status"]
    'NOT_CLOSED'
    """

    object: str
    view: str
    status: Status = Status.OK
    note: str = ""
    family: str = ""
    group: str = ""
    executable: int = 0
    points: int = 0
    grasps: int = 0
    passed: int = 0
    meta: dict[str, str] = {}  # noqa: RUF012

    def as_json(self) -> dict[str, Any]:
        """Return a dict of all fields by name, for `json.dumps`; `status` becomes its name."""
        return {**self._asdict(), "status": self.status.name}


@dataclasses.dataclass(frozen=True)
class Records(Value):
    """The results of several jobs (one view of one object each), one after the other.

    Lengths are in metres, in the object's frame. There are p points and g grasps of j jobs, and d
    trials of each grasp. `Shard.rows` says how many points and grasps each job has.

    Attributes:
        points: points (p, 3) [m] of the clouds of all jobs.
        viewpoints: position (j, 3) [m] of the camera of each job; zeros without a camera.
        grasps: grasps of all jobs.
        passed: mask (g, d) of the simulated trials that passed.
        outcome: `Status` (g, d) of each simulated trial, as an integer.
    """

    points: Float[Tensor, "p 3"]
    viewpoints: Float[Tensor, "j 3"]
    grasps: Grasps
    passed: Bool[Tensor, "g d"]
    outcome: Int[Tensor, "g d"]


class Shard(NamedTuple):
    """The content of a shard, a file of a campaign's data set that holds several jobs.

    A job is one view of one object, with its planned grasps and their trials.

    Attributes:
        rows: the outcomes of several jobs.
        records: the tensors of all these jobs, in the same order.
    """

    rows: tuple[JobRow, ...]
    records: Records

    def take(self, i: int) -> "Shard":
        """Return a shard that holds only job `i` of this one, counted from 0 in `rows`."""
        row = self.rows[i]
        before = self.rows[:i]
        p = sum(x.points for x in before)
        g = sum(x.grasps for x in before)
        points = slice(p, p + row.points)
        grasps = slice(g, g + row.grasps)
        records = self.records
        tried = records.grasps[grasps], records.passed[grasps], records.outcome[grasps]
        return Shard((row,), Records(records.points[points], records.viewpoints[i : i + 1], *tried))


def shard_ranges(jobs: int, size: int) -> list[range]:
    """Return the indices of the jobs in each shard, a file of a data set.

    `jobs` is the number of all jobs. Each shard has `size` jobs in order; the last one has the
    rest.
    """
    return [range(first, min(first + size, jobs)) for first in range(0, jobs, size)]


def join_shards(parts: Sequence[Shard]) -> Shard:
    """Return one shard with all jobs of several shards, in the order of `parts`."""
    records = map_tensors(lambda *tensors: torch.cat(tensors), *(part.records for part in parts))
    return Shard(tuple(itertools.chain(*(part.rows for part in parts))), records)


def pack_shard(shard: Shard, meta: dict[str, str]) -> bytes:
    """Return the bytes of a safetensors file with the jobs of a shard.

    `meta` holds texts by name that identify the campaign; the file has them as metadata.
    """
    jobs = json.dumps([row.as_json() for row in shard.rows])
    return pack_tensors(KIND, named_tensors(shard.records), {**meta, "jobs": jobs})


def load_shard(path: Path, meta: dict[str, str]) -> Shard:
    """Return the content of a shard file, which holds jobs of a campaign.

    Raises `ModelFileError` if the file is missing or damaged. Raises it also if an entry of `meta`
    is not in the file's metadata: then the file belongs to another campaign.
    """
    records, found = read_value(path, KIND, Records)
    if (other := {key: found.get(key) for key in meta}) != meta:
        raise ModelFileError("path", f"{path} of {other}", f"a shard of {meta}")
    refuse = functools.partial(ModelFileError, "path")
    try:
        jobs = json.loads(found.get("jobs", ""))
    except (ValueError, RecursionError) as error:
        raise refuse(f"{path}: {error}", "a shard with a list of its jobs") from error
    rows = tuple(read_row(field) for field in Field(path, "jobs", jobs, refuse).items(MOST))
    check_grasps(path, records.grasps)
    counted = sum(row.points for row in rows), len(rows), sum(row.grasps for row in rows)
    sizes = len(records.points), len(records.viewpoints), len(records.grasps)
    known = {int(status) for status in Status}
    if counted != sizes or not set(records.outcome.unique().tolist()) <= known:
        found = f"{path} of {counted} points, jobs and grasps, with tensors of {sizes}"
        raise refuse(found, "equal counts")
    return Shard(rows, records)


def read_row(field: Field, bare: bool = False) -> JobRow:
    """Return the outcome of a job, read from its JSON object `field`.

    If `bare`, the object has no "meta", and the result's `meta` is empty. Wrong content raises the
    error that `field` was made with, such as `ModelFileError`.
    """
    fields = field.entries(*JobRow._fields[: -1 if bare else None])  # the metadata comes last
    texts = {name: fields[name].text() for name in ("object", "view", "note", "family", "group")}
    counted = ("executable", "points", "grasps", "passed")
    counts = {name: fields[name].whole(0, MOST) for name in counted}
    status = fields["status"].text()
    if status not in Status.__members__:
        raise fields["status"].wrong("the name of a Status")
    meta = {}
    if not bare:
        entries = fields["meta"].entries()
        meta = {key: x.text(META_LETTERS) for key, x in entries.items()}
    return JobRow(**texts, status=Status[status], **counts, meta=meta)  # pyright: ignore[reportArgumentType]


def short(text: str) -> str:
    """Return a text on one line, cut to 200 characters: `read_row` accepts no more in one field.

    A text that is cut ends with "...".
    """
    line = one_line(text)
    return line if len(line) <= JSON_LETTERS else f"{line[: JSON_LETTERS - 3]}..."


@checked
def load_grasps(path: Path | str) -> Grasps:
    """Return the grasps in a file that `Grasps.save` wrote.

    Raises `ModelFileError` if the file is missing or malformed, or holds an invalid pose, status or
    number of contacts.

    >>> import tempfile
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> file = Path(tempfile.mkdtemp(), "grasps.safetensors")
    >>> load_shipped_grasp("jug", "barrett").save(file)
    >>> load_grasps(file).meta["hand"]
    'barrett'
    """
    grasps, meta = read_value(path, "grasps", Grasps, meta={})
    check_grasps(path, grasps)
    return dataclasses.replace(grasps, meta=meta)


def check_grasps(path: Path | str, grasps: Grasps) -> None:
    """Raise `ModelFileError` unless grasps, read from the file `path`, can be those of
    `Grasps.save`.

    They cannot if a pose is not rigid, a status is unknown, or a permutation is none. A grasp has
    three to five contacts.
    """
    f = grasps.contacts.fingertips
    known = torch.tensor([int(status) for status in Status], device="cpu")
    fingers = torch.arange(f, device="cpu")
    few = torch.tensor([not FINGERTIPS[0] <= f <= FINGERTIPS[1]], device="cpu")
    sorted_fingers = grasps.permutation.sort(1).values
    wrong = {
        f"{f} fingertips, not three to five": few,
        "obj_from_hand that is not rigid": ~is_rigid(grasps.obj_from_hand),
        "an unknown status": ~torch.isin(grasps.status, known),
        "a permutation that does not name each fingertip once": (sorted_fingers != fingers).any(1),
    }
    for found in (name for name, rows in wrong.items() if bool(rows.any())):
        raise ModelFileError("path", f"{path}: {found}", "grasps that Grasps.save wrote")
