"""The folder of a campaign: one file for each finished job until its shard is complete. Also the
data set's cards.
"""

import contextlib
import hashlib
import json
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torchgrasp.data.reader import CARD, GraspShards, read_shards, shard_path
from torchgrasp.data.shards import JobRow, Shard, join_shards, load_shard, pack_shard, shard_ranges
from torchgrasp.data.table_folder import render_card
from torchgrasp.files import begin_folder, format_json, hold_folder, remove_file, sha256, write_file
from torchgrasp.foundation.errors import ModelFileError, Status

ASKED = "campaign.json"
README = "README.md"
PARTS = "parts"
"""Names in a campaign's folder: its request, its text for people, and the folder for jobs of
incomplete shards.
"""
ROUNDS = 3
"""How often a job whose process died is tried in one call. A dying process also ends jobs beside
its own.
"""
FAILED = (Status.WORKER_DIED, Status.TIMED_OUT, Status.BROKEN)
"""Statuses of a failed job that say nothing about its object: the next call tries the job again."""
Work = Callable[[Sequence[int]], Generator[tuple[int, bytes | Status], None, None]]
"""Function of job indices that yields a pair as each job ends. It is a position in these indices,
and a file or a failure.
"""


class Campaign(NamedTuple):
    """The settings of a campaign, and its jobs; a job is one view of one object.

    Attributes:
        asked: all settings on which the results depend: hand, protocol, options, versions of
            packages, and a hash of the objects. `campaign.json` holds them.
        rows: object and view of each job; a job with a status other than OK is not run.
        empty: function that makes the data of a job without grasps, given its row.
    """

    asked: dict[str, Any]
    rows: tuple[JobRow, ...]
    empty: Callable[[JobRow], Shard]

    @property
    def text(self) -> str:
        """The text of `campaign.json`: the settings `asked` as JSON."""
        return format_json(self.asked) + "\n"

    @property
    def meta(self) -> dict[str, str]:
        """The metadata of each shard, a file of the data set.

        "campaign" is a hash of all settings, and "versions" are those of packages, as JSON.
        """
        digest = hashlib.sha256(self.text.encode()).hexdigest()
        return {"campaign": digest, "versions": json.dumps(self.asked["versions"])}


def carry_out(
    campaign: Campaign,
    folder: Path,
    work: Work,
    observer: Callable[[JobRow], object] = lambda row: None,
) -> GraspShards:
    """Run the jobs of a campaign that are not yet in its `folder`; write the data set there, and
    return it.

    `work` is a function that runs jobs, given their indices. As each job ends, it yields a pair.
    First is the job's position among these indices. Second are the bytes of the job's shard file,
    or a `Status` if it failed. A job with `Status.WORKER_DIED` is run up to three times (`ROUNDS`).
    `observer` is called with the `JobRow` of each finished job. Raises `OutputError` if the folder
    holds another campaign or other files.
    """
    with hold_folder(folder):
        begin_folder(folder / ASKED, campaign.text, "campaigns")
        store = _Store(campaign, folder)
        for j in store.missing():
            if campaign.rows[j].status is not Status.OK:
                observer(store.put(j, pack_shard(campaign.empty(campaign.rows[j]), campaign.meta)))
        waiting = store.missing()
        lost = dict[int, Status]()
        if waiting:
            remove_file(folder / CARD)  # until the new one is true
        for _ in range(ROUNDS):
            with contextlib.closing(work(waiting)) as results:  # which ends the workers
                for place, result in results:
                    j = waiting[place]
                    if isinstance(result, Status):
                        lost[j] = result
                    else:
                        lost.pop(j, None)
                        observer(store.put(j, result))
            waiting = [j for j, status in lost.items() if status is Status.WORKER_DIED]
            if not waiting:
                break
        for j, status in sorted(lost.items()):
            row = campaign.rows[j]._replace(status=status)
            observer(store.put(j, pack_shard(campaign.empty(row), campaign.meta)))
        store.finish()
    return read_shards(folder)


class _Store:
    """The files of a campaign; `rows` holds, by index, the rows of all jobs that are undamaged on
    disk.
    """

    def __init__(self, campaign: Campaign, folder: Path) -> None:
        self.campaign = campaign
        self.folder = folder
        self.size = int(campaign.asked["jobs_in_shard"])
        # the indices of the jobs in each shard
        self.shards = shard_ranges(len(campaign.rows), self.size)
        self.rows: dict[int, JobRow] = {}
        self.digests: dict[int, str] = {}
        for k in range(len(self.shards)):
            rows = {j: shard.rows[0]._replace(meta={}) for j, shard in self._find(k).items()}
            self.rows |= {j: row for j, row in rows.items() if row.status not in FAILED}
            self._close(k)

    def missing(self) -> list[int]:
        """Return the indices of the jobs whose results are not yet in the folder."""
        return [j for j in range(len(self.campaign.rows)) if j not in self.rows]

    def put(self, j: int, data: bytes) -> JobRow:
        """Write the file content `data` of the finished job j to disk; return the job's row."""
        (shard,) = self._load(write_file(self._part(j), data), [j])
        self.rows[j] = shard.rows[0]._replace(meta={})
        self._close(j // self.size)
        return self.rows[j]

    def finish(self) -> None:
        """Write the README, then `card.json`, which marks a complete data set; remove the folder of
        single jobs.
        """
        rows = [self.rows[j] for j in range(len(self.campaign.rows))]
        card = card_of(self.campaign, rows, [self.digests[k] for k in range(len(self.shards))])
        write_file(self.folder / README, render_card("shards.md", card=card))
        write_file(self.folder / CARD, format_json(card) + "\n")
        with contextlib.suppress(OSError):  # it may hold what is not ours
            (self.folder / PARTS).rmdir()

    def _find(self, k: int) -> dict[int, Shard]:
        """Return the undamaged jobs of shard k by index, read from the file of the job or of the
        shard.
        """
        jobs = self.shards[k]
        found = dict[int, Shard]()
        with contextlib.suppress(ModelFileError):
            found = dict(zip(jobs, self._load(shard_path(self.folder, k), jobs), strict=True))
        for j in jobs:
            with contextlib.suppress(ModelFileError):
                (found[j],) = self._load(self._part(j), [j])
        return found

    def _close(self, k: int) -> None:
        """If all jobs of shard k have finished, write the shard file and remove the files of the
        single jobs.
        """
        path = shard_path(self.folder, k)
        jobs = self.shards[k]
        if any(j not in self.rows for j in jobs):
            return
        if any(self._part(j).is_file() for j in jobs):
            found = self._find(k)
            write_file(path, pack_shard(join_shards([found[j] for j in jobs]), self.campaign.meta))
        self.digests[k] = sha256(path)
        for j in jobs:
            remove_file(self._part(j))

    def _part(self, j: int) -> Path:
        """Return the path of the file of job j, used until its shard is complete."""
        return self.folder / PARTS / f"job-{j:06d}.safetensors"

    def _load(self, path: Path, jobs: Sequence[int]) -> list[Shard]:
        """Return the jobs in a file, one shard for each job; raise `ModelFileError` unless they are
        the given jobs.
        """
        shard = load_shard(path, self.campaign.meta)
        held = [(row.object, row.view) for row in shard.rows]
        rows = [self.campaign.rows[j] for j in jobs]
        asked = [(row.object, row.view) for row in rows]
        if held != asked:
            raise ModelFileError("path", f"{path} of {held}", f"{asked}")
        return [shard.take(i) for i in range(len(jobs))]


def card_of(campaign: Campaign, rows: Sequence[JobRow], digests: list[str]) -> dict[str, Any]:
    """Return the content of `card.json`, the summary of a campaign's data set, as a dict for JSON.

    It holds the settings, the outcome of each job, and counts of jobs, grasps and trials. `rows`
    are the outcomes, and `digests` the SHA-256 of each shard in hexadecimal digits.
    """
    asked = campaign.asked
    tries = campaign.asked["protocol"]["noise"]["draws"]
    counts = {
        "jobs": len(rows),
        "status": dict(Counter(row.status.name for row in rows).most_common()),
        "objects": len({row.object for row in rows}),
        "families": len({row.family or row.object for row in rows}),
        "groups": dict(sorted(Counter(row.group for row in rows if row.group).items())),
        "points": sum(row.points for row in rows),
        "grasps": sum(row.grasps for row in rows),
        "tries": tries * sum(row.grasps for row in rows),
        "passed": sum(row.passed for row in rows),
    }
    jobs = [{name: x for name, x in row.as_json().items() if name != "meta"} for row in rows]
    return {
        "torchgrasp": "grasp-shards",
        "version": 1,
        "licence": asked["licence"],
        "campaign": campaign.meta["campaign"],
        "jobs_in_shard": asked["jobs_in_shard"],
        "asked": asked,
        "counts": counts,
        "shards_sha256": digests,
        "jobs": jobs,
    }
