"""A campaign whose jobs cost nothing: their records are drawn by number. Workers import this
module.
"""

import os
import signal
import time
from collections.abc import Generator, Sequence
from pathlib import Path

import torch

from torchgrasp.campaign.folder import Campaign
from torchgrasp.data.shards import JobRow, Records, Shard, pack_shard
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.jobs import run_as_they_end
from torchgrasp.values.planning import Certificate, Contacts, Grasps

JOINTS = 4
FINGERS = 3
TRIES = 2
"""Sizes of the records."""
ASKED = {
    "torchgrasp": "campaign",
    "version": 1,
    "licence": "CC0-1.0",
    "hand": {
        "name": "toy",
        "option": "default",
        "sha256": "0" * 64,
        "joint_names": "a, b, c, d",
        "finger_names": "f",
    },
    "protocol": {
        "name": "toy",
        "noise": {"draws": TRIES},
        "trial": {"simulator": "none", "friction": 0.5},
    },
    "trials": {"grasps": 3, "ranks": "best", "starts": 1, "seed": 0},
    "versions": {"torchgrasp": "0", "mujoco": "none"},
    "device": "cpu",
}


def campaign(jobs: int, size: int = 8) -> Campaign:
    """Return a campaign of so many jobs, the third of which is refused before any work."""
    rows = [JobRow(f"thing{j // 2:03}", f"view{j % 2}", family=f"kind{j % 5}") for j in range(jobs)]
    if jobs > 2:
        rows[2] = rows[2]._replace(status=Status.BAD_OBJECT, note="no mesh")
    return Campaign(ASKED | {"jobs_in_shard": size}, tuple(rows), empty)


def empty(row: JobRow) -> Shard:
    return Shard((row,), records(torch.Generator(), 0, 0))


def records(rng: torch.Generator, points: int, count: int, tries: int = TRIES) -> Records:
    """Return sound records of one job."""

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=rng, dtype=torch.float64)

    f = FINGERS
    n = count
    contacts = Contacts(draw(n, f, 3), draw(n, f, 3), draw(n, f), draw(n, f))
    certificate = Certificate(draw(n), draw(n), draw(n), draw(n) > 0.5, draw(n, 6))
    pose = torch.eye(4, dtype=torch.float64).repeat(n, 1, 1)
    order = torch.arange(f).repeat(n, 1)
    status = torch.zeros(n, dtype=torch.int64)
    grasps = Grasps(
        draw(n, JOINTS),
        draw(n, JOINTS),
        draw(n, 3),
        pose,
        contacts,
        order,
        draw(n, f),
        draw(n),
        draw(n, f),
        certificate,
        draw(n),
        status,
        known=status == 0,
        interval=torch.zeros(n, 2, dtype=torch.float64),
    )
    passed = draw(n, tries) > 0.4
    outcome = torch.where(passed, int(Status.OK), int(Status.DROPPED))
    return Records(draw(points, 3), draw(1, 3), grasps, passed, outcome)


def cheap_job(
    number: int, row: JobRow, meta: dict[str, str], pause: float = 0.0, marks: str = ""
) -> bytes:
    """Return the file of a job; leave the process's number among the marks while at it."""
    mark = Path(marks) / str(os.getpid())
    if marks:
        mark.touch()
    time.sleep(pause)
    rng = torch.Generator().manual_seed(number)
    count = number % 4
    drawn = records(rng, 5 + number % 3, count)
    row = row._replace(
        status=Status.OK if count else Status.NOT_CLOSED,
        executable=count,
        points=5 + number % 3,
        grasps=count,
        passed=int(drawn.passed.sum()),
        meta={"cloud_sha256": str(number)},
    )
    mark.unlink(missing_ok=True) if marks else None
    return pack_shard(Shard((row,), drawn), meta)


def die_at(number: int, row: JobRow, meta: dict[str, str], deadly: int) -> bytes:
    if number == deadly:
        os.kill(os.getpid(), signal.SIGKILL)
    return cheap_job(number, row, meta)


def seen_job(
    number: int, row: JobRow, meta: dict[str, str], plans: list[int] | None = None
) -> bytes:
    """Do a job on a worker in this process; with plans, it is the job that has the number's plan."""
    from tests.campaign.swarm import begin  # not at the top: other workers need no Dask

    begin(number)
    return cheap_job(number if plans is None else plans[number % len(plans)], row, meta)


def seen_plan(numbers: list[int]) -> list[int]:
    """Return the numbers of jobs as their plans."""
    from tests.campaign.swarm import begin

    begin(-1 - numbers[0])
    return numbers


def wait_at(number: int, row: JobRow, meta: dict[str, str], patient: int, path: str) -> bytes:
    while number == patient and not Path(path).exists():
        time.sleep(0.02)
    return cheap_job(number, row, meta)


def work_on(asked: Campaign, workers: int, function=cheap_job, *more):
    """Return the work of `carry_out` on processes here."""

    def work(numbers: Sequence[int]) -> Generator[tuple[int, bytes | Status], None, None]:
        tasks = [(j, asked.rows[j], asked.meta, *more) for j in numbers]
        return run_as_they_end(function, tasks, workers, 60.0)

    return work


def contents(folder: Path) -> dict[str, bytes]:
    """Return every file below a folder, by its path there."""
    return {
        str(x.relative_to(folder)): x.read_bytes() for x in sorted(folder.rglob("*")) if x.is_file()
    }
