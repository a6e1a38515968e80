"""The folder of a campaign: jobs that ended, each as a file of its own until its shard is whole; then the card."""

import contextlib
import hashlib
import json
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torchgrasp.campaign.card import card_of, describe
from torchgrasp.data.reader import CARD, GraspShards, read_shards, shard_path
from torchgrasp.data.shards import JobRow, Shard, join_shards, load_shard, pack_shard
from torchgrasp.errors import ModelFileError, Status
from torchgrasp.files import begin_folder, format_json, hold_folder, remove_file, sha256, write_file

ASKED, README, PARTS = "campaign.json", "README.md", "parts"
"""What was asked; the card for people; the folder of jobs whose shard is not whole yet."""
ROUNDS = 3
"""How often a job whose process died is tried in one call, and twice each time: the innocent die with the guilty."""
FAILED = (Status.WORKER_DIED, Status.TIMED_OUT, Status.BROKEN)
"""Ends of a job that say nothing about its object: the next call tries it again."""

Work = Callable[[Sequence[int]], Generator[tuple[int, bytes | Status], None, None]]
"""Takes numbers of jobs; yields, as they end, place among these and file of each, or how its process ended."""


class Campaign(NamedTuple):
    """What is asked, as `campaign.json` has it, and a row for each job.

    A row whose status is not OK is refused before any work.
    """

    asked: dict[str, Any]
    rows: tuple[JobRow, ...]
    empty: Callable[[JobRow], Shard]

    @property
    def text(self) -> str:
        """The content of `campaign.json`."""
        return format_json(self.asked) + "\n"

    @property
    def meta(self) -> dict[str, str]:
        """What the metadata of each shard says."""
        digest = hashlib.sha256(self.text.encode()).hexdigest()
        return {"campaign": digest, "versions": json.dumps(self.asked["versions"])}


def carry_out(
    campaign: Campaign, folder: Path, work: Work, observer: Callable[[JobRow], object] = lambda row: None
) -> GraspShards:
    """Do all jobs that a folder lacks, and finish it; the observer gets the row of each job that was done.

    Raises:
        OutputError: the folder holds another campaign or other files, another run holds it, or it cannot be written.
    """
    with hold_folder(folder):
        begin_folder(folder / ASKED, campaign.text, "campaigns")
        store = _Store(campaign, folder)
        for j in store.missing():
            if campaign.rows[j].status is not Status.OK:
                observer(store.put(j, pack_shard(campaign.empty(campaign.rows[j]), campaign.meta)))
        waiting, lost = store.missing(), dict[int, Status]()
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
    """The files of a campaign; `rows` are those of the jobs that are on disk and sound."""

    def __init__(self, campaign: Campaign, folder: Path) -> None:
        self.campaign, self.folder = campaign, folder
        self.size = int(campaign.asked["jobs_in_shard"])
        self.shards = range(-(-len(campaign.rows) // self.size))
        self.rows: dict[int, JobRow] = {}
        self.digests: dict[int, str] = {}
        for k in self.shards:
            self._look(k)

    def missing(self) -> list[int]:
        """Return the jobs that have to be done."""
        return [j for j in range(len(self.campaign.rows)) if j not in self.rows]

    def put(self, j: int, data: bytes) -> JobRow:
        """Write the file of a job; return its row."""
        row = self._row_of(j, load_shard(write_file(self._part(j), data), self.campaign.meta))
        self.rows[j] = row._replace(meta={})
        self._close(j // self.size)
        return self.rows[j]

    def finish(self) -> None:
        """Write the cards, that for programs last, and remove what is no more needed."""
        rows = tuple(self.rows[j] for j in range(len(self.campaign.rows)))
        digests = [self.digests[k] for k in self.shards]
        card = card_of(self.campaign.asked, self.campaign.meta["campaign"], rows, digests)
        write_file(self.folder / README, describe(card))
        write_file(self.folder / CARD, format_json(card) + "\n")
        with contextlib.suppress(OSError):  # it may hold what is not ours
            (self.folder / PARTS).rmdir()

    def _look(self, k: int) -> None:
        """Find the sound jobs of a shard: in its file, or each in its own."""
        settled = {j: row for j, row in self._saved(k).items() if row.status not in FAILED}
        self.rows |= settled
        if len(settled) == len(self._jobs(k)):
            self._settle(k)
            return
        for j in self._jobs(k):
            if j not in settled:
                with contextlib.suppress(ModelFileError):
                    row = self._row_of(j, load_shard(self._part(j), self.campaign.meta))
                    if row.status not in FAILED:
                        self.rows[j] = row._replace(meta={})
        self._close(k)

    def _saved(self, k: int) -> dict[int, JobRow]:
        """Return the rows of a shard's file; none if it is not there, or damaged."""
        try:
            shard = load_shard(shard_path(self.folder, k), self.campaign.meta)
            jobs = self._jobs(k)
            if len(shard.rows) != len(jobs):
                return {}
            return {j: self._row_of(j, shard.take(i))._replace(meta={}) for i, j in enumerate(jobs)}
        except ModelFileError:
            return {}

    def _close(self, k: int) -> None:
        """Write a shard whose jobs have all ended."""
        if any(j not in self.rows for j in self._jobs(k)):
            return
        path, parts = shard_path(self.folder, k), []
        for i, j in enumerate(self._jobs(k)):
            try:
                parts.append(load_shard(self._part(j), self.campaign.meta))
            except ModelFileError:
                parts.append(load_shard(path, self.campaign.meta).take(i))
        write_file(path, pack_shard(join_shards(parts), self.campaign.meta))
        self._settle(k)

    def _settle(self, k: int) -> None:
        """Note the hash of a shard that is whole, and remove the files of its jobs."""
        self.digests[k] = sha256(shard_path(self.folder, k))
        for j in self._jobs(k):
            remove_file(self._part(j))

    def _jobs(self, k: int) -> range:
        """Return the jobs of a shard."""
        return range(k * self.size, min((k + 1) * self.size, len(self.campaign.rows)))

    def _part(self, j: int) -> Path:
        """Return the file of a job that is not yet in its shard."""
        return self.folder / PARTS / f"job-{j:06d}.safetensors"

    def _row_of(self, j: int, shard: Shard) -> JobRow:
        """Return the row of a shard of one job; refuse that of another job."""
        row, asked = shard.rows[0], self.campaign.rows[j]
        if len(shard.rows) != 1 or (row.object, row.view) != (asked.object, asked.view):
            raise ModelFileError("path", f"{(row.object, row.view)}", f"{(asked.object, asked.view)}")
        return row
