"""The folder of a campaign: one file for each finished job until its shard is complete, and the data set's cards."""

import contextlib
import hashlib
import json
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torchgrasp.data.reader import CARD, GraspShards, read_shards, shard_path
from torchgrasp.data.shards import JobRow, Shard, join_shards, load_shard, pack_shard
from torchgrasp.errors import ModelFileError, Status
from torchgrasp.files import begin_folder, format_json, hold_folder, remove_file, sha256, write_file

ASKED, README, PARTS = "campaign.json", "README.md", "parts"
"""Names in a campaign's folder: its request, its text for people, and the folder for jobs of incomplete shards."""
ROUNDS = 3
"""How often a job whose process died is tried in one call, because a dying process also ends jobs beside its own."""
FAILED = (Status.WORKER_DIED, Status.TIMED_OUT, Status.BROKEN)
"""Statuses of a failed job that say nothing about its object: the next call tries the job again."""
Work = Callable[[Sequence[int]], Generator[tuple[int, bytes | Status], None, None]]
"""Function of job indices that yields, as each job ends, a position in these indices, and a file or a failure."""
FIELDS = (
    ("points", "p x 3", "cloud of each job, one behind the other [m]"),
    ("viewpoints", "j x 3", "position of the camera [m]; zeros: unknown"),
    ("grasps.joints, grasps.pregrasp", "g x h", "actuated joints, closed and opened [rad]"),
    ("grasps.obj_from_hand", "g x 4 x 4", "pose of the hand's base link in the object's frame [m]"),
    ("grasps.approach", "g x 3", "direction of the straight path to the pre-grasp"),
    ("grasps.contacts.points, .normals", "g x f x 3", "planned contacts and outward normals"),
    ("grasps.contacts.std_m", "g x f", "standard deviation of the surface at the contact [m]"),
    ("grasps.contacts.variance", "g x f", "the same in the normalised units of the shape"),
    ("grasps.certificate.margin, .closed", "g", "how far from losing form closure, and whether it has it"),
    ("grasps.certificate.witness", "g x 6", "the wrench that is hardest to resist"),
    ("grasps.certificate.rank_ratio, .residual", "g", "how well the certificate itself is conditioned"),
    ("grasps.clearance, .tip_error, .normal_angle", "g, g x f, g x f", "distances [m] and angles [rad] of the plan"),
    ("grasps.permutation", "g x f", "contact of each finger in the plan"),
    ("grasps.score", "g", "log-odds of the predicted success"),
    ("grasps.status", "g", "0: executable; all are"),
    ("passed, outcome", "g x d", "verdict of each try in the simulator, and its Status"),
)
"""The tensors in a shard file: name, shape and meaning of each."""


class Campaign(NamedTuple):
    """The request of a campaign, as in `campaign.json`, and one row for each job (one view of one object)."""

    asked: dict[str, Any]
    rows: tuple[JobRow, ...]  # a job whose row has a status other than OK is not run
    empty: Callable[[JobRow], Shard]  # makes the data of a job without grasps from its row

    @property
    def text(self) -> str:
        """The content of `campaign.json`."""
        return format_json(self.asked) + "\n"

    @property
    def meta(self) -> dict[str, str]:
        """The metadata of each shard: hash of the request, and package versions."""
        digest = hashlib.sha256(self.text.encode()).hexdigest()
        return {"campaign": digest, "versions": json.dumps(self.asked["versions"])}


def carry_out(
    campaign: Campaign, folder: Path, work: Work, observer: Callable[[JobRow], object] = lambda row: None
) -> GraspShards:
    """Run the jobs that a folder lacks, and write its data set; the observer gets the row of each finished job."""
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
    """The files of a campaign; `rows` holds, by index, the rows of all jobs that are undamaged on disk."""

    def __init__(self, campaign: Campaign, folder: Path) -> None:
        self.campaign, self.folder = campaign, folder
        self.size = int(campaign.asked["jobs_in_shard"])
        self.shards = range(-(-len(campaign.rows) // self.size))
        self.rows: dict[int, JobRow] = {}
        self.digests: dict[int, str] = {}
        for k in self.shards:
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
        """Write the README, then `card.json`, which marks a complete data set; remove the folder of single jobs."""
        rows = [self.rows[j] for j in range(len(self.campaign.rows))]
        card = card_of(self.campaign, rows, [self.digests[k] for k in self.shards])
        write_file(self.folder / README, describe(card))
        write_file(self.folder / CARD, format_json(card) + "\n")
        with contextlib.suppress(OSError):  # it may hold what is not ours
            (self.folder / PARTS).rmdir()

    def _find(self, k: int) -> dict[int, Shard]:
        """Return the undamaged jobs of shard k by index, read from the file of the job or of the shard."""
        jobs, found = self._jobs(k), dict[int, Shard]()
        with contextlib.suppress(ModelFileError):
            found = dict(zip(jobs, self._load(shard_path(self.folder, k), jobs), strict=True))
        for j in jobs:
            with contextlib.suppress(ModelFileError):
                (found[j],) = self._load(self._part(j), [j])
        return found

    def _close(self, k: int) -> None:
        """If all jobs of shard k have finished, write the shard file and remove the files of the single jobs."""
        path, jobs = shard_path(self.folder, k), self._jobs(k)
        if any(j not in self.rows for j in jobs):
            return
        if any(self._part(j).is_file() for j in jobs):
            found = self._find(k)
            write_file(path, pack_shard(join_shards([found[j] for j in jobs]), self.campaign.meta))
        self.digests[k] = sha256(path)
        for j in jobs:
            remove_file(self._part(j))

    def _jobs(self, k: int) -> range:
        """Return the indices of the jobs whose results are stored in shard k."""
        return range(k * self.size, min((k + 1) * self.size, len(self.campaign.rows)))

    def _part(self, j: int) -> Path:
        """Return the path of the file of job j, used until its shard is complete."""
        return self.folder / PARTS / f"job-{j:06d}.safetensors"

    def _load(self, path: Path, jobs: Sequence[int]) -> list[Shard]:
        """Return the jobs in a file, one shard for each job; raise `ModelFileError` unless they are the given jobs."""
        shard = load_shard(path, self.campaign.meta)
        held = [(row.object, row.view) for row in shard.rows]
        if held != (asked := [(self.campaign.rows[j].object, self.campaign.rows[j].view) for j in jobs]):
            raise ModelFileError("path", f"{path} of {held}", f"{asked}")
        return [shard.take(i) for i in range(len(jobs))]


def card_of(campaign: Campaign, rows: Sequence[JobRow], digests: list[str]) -> dict[str, Any]:
    """Return the content of `card.json`, given the rows of all jobs and the SHA-256 of each shard."""
    asked, tries = campaign.asked, campaign.asked["protocol"]["noise"]["draws"]
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
        "torchgrasp": "grasp-shards", "version": 1, "licence": asked["licence"], "campaign": campaign.meta["campaign"],
        "jobs_in_shard": asked["jobs_in_shard"], "asked": asked, "counts": counts, "shards_sha256": digests,
        "jobs": jobs,
    }  # fmt: skip


def describe(card: dict[str, Any]) -> str:
    """Return the content of `card.json` as a README in Markdown, with the header that data set hubs read."""
    asked, counts = card["asked"], card["counts"]
    hand, protocol, trials = asked["hand"], asked["protocol"], asked["trials"]
    reasons = "\n".join(f"| {name.lower()} | {n} | {Status[name].sentence} |" for name, n in counts["status"].items())
    fields = "\n".join(f"| {name} | {shape} | {meaning} |" for name, shape, meaning in FIELDS)
    versions = ", ".join(f"{name} {version}" for name, version in asked["versions"].items() if version != "none")
    share = f"{counts['passed']} of {counts['tries']} tries passed" if counts["tries"] else "nothing was tried"
    tags = "tags: [robotics, dexterous-grasping]"
    return f"""---
license: {_quoted(card["licence"])}
{tags}
---
# Grasps of the {hand["name"]} hand, tried under "{protocol["name"]}"

Grasps that torchgrasp planned on partial point clouds, each with its certificate of frictional form closure, the
standard deviation of the surface at its contacts, its predicted success, and its success in simulation.

* {counts["jobs"]} jobs, one for each view of {counts["objects"]} objects of {counts["families"]} families
* {counts["grasps"]} grasps; {share}
* licence: {card["licence"]}
* hand: {hand["name"]}, fingers {hand["finger_names"]}, SHA-256 {hand["sha256"]}
* grasps of a view: {trials["grasps"]} at most ({trials["ranks"]}), of {trials["starts"]} starts, seed {trials["seed"]}
* simulator: {protocol["trial"]["simulator"]}, friction {protocol["trial"]["friction"]:g}
* planned on {asked["device"]}, made with {versions}

| status of a job | jobs | meaning |
| --- | --- | --- |
{reasons}

## Reading

```python
from torchgrasp.data import read_shards

data = read_shards(".", points=512)  # for a torch DataLoader: each item is a dict of one grasp
first = data.job(0)  # or job by job: row, cloud, grasps, passed, outcome
```

`card.json` has a row for each job, and all that was asked. `shard-NNNNNN.safetensors` holds {card["jobs_in_shard"]}
jobs, one behind the other; its metadata says how many points and grasps are each job's. Lengths are metres, angles
radians, in the frame of the object.

| tensor | shape | meaning |
| --- | --- | --- |
{fields}

p points, j jobs, g grasps, d tries of a grasp, h joints ({hand["joint_names"]}), f fingers.
"""


def _quoted(text: str) -> str:
    """Return a text as a YAML value for the header of the README."""
    return text.lower() if text.replace("-", "").replace(".", "").isalnum() else '"' + text.replace('"', "'") + '"'
