"""The scheduler of a campaign on a thousand workers, of which one in a hundred dies: files, time
and memory.
"""

import dataclasses
import functools
import gc
import json
import tempfile
import time
import tracemalloc
from collections.abc import Generator, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from distributed import Client

from benchmarks.common import Options, Row, bench, timed
from benchmarks.load.repeat import resident_mib
from benchmarks.load.swarm import BEGAN, FATAL, begin, outstanding, swarm
from torchgrasp import load_hand
from torchgrasp.campaign.cluster import OUTSTANDING, empty_shard, run_job, run_on_cluster, versions
from torchgrasp.campaign.folder import Campaign, carry_out
from torchgrasp.data.shards import JobRow, Shard, pack_shard
from torchgrasp.evaluation import PROTOCOLS, EvaluationSpec
from torchgrasp.evaluation.views import ObjectView
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.jobs import run_as_they_end
from torchgrasp.hand.hand import Hand

WORKERS = 1000
JOBS = 10
DYING = 0.01
"""Workers, jobs for each of them, and the share of workers that die, evenly over the run."""
POINTS = 1000  # of a job's cloud, all that it writes
LIMIT = 600.0  # of a job [s]; none takes so long
MILLION = 1_000_000
ASKED = {
    "torchgrasp": "campaign",
    "version": 1,
    "licence": "unknown",
    "jobs_in_shard": 64,
    "device": "cpu",
    "hand": {
        "name": "none",
        "option": "",
        "sha256": "0" * 64,
        "joint_names": "",
        "finger_names": "",
    },
    "protocol": {
        "name": "none",
        "noise": {"draws": 1},
        "trial": {"simulator": "none", "friction": 0.5},
    },
    "trials": {"grasps": 1, "ranks": "best", "starts": 1, "seed": 0},
    "versions": {"torchgrasp": "0"},
}


@bench("load/scheduler")
def scheduler(o: Options) -> list[Row]:
    """Run jobs without work by `carry_out` on the real scheduler, and alone in this process;
    compare the files.
    """
    workers = max(4, o.times(WORKERS))
    jobs = JOBS * workers
    dying = max(1, round(DYING * workers))
    rows = tuple(JobRow(f"thing{j:06}", "view0") for j in range(jobs))
    campaign = Campaign(ASKED, rows, lambda row: empty_shard(row, barrett(), 1))
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        _, alone = timed(lambda: carry_out(campaign, folder / "alone", _here(campaign)))
        told = list[JobRow]()
        held = list[int]()
        memory = list[float]()
        with swarm(workers) as cluster:
            FATAL.update({(2 * k + 1) * jobs // (2 * dying): cluster for k in range(dying)})

            def work(numbers: Sequence[int]) -> Generator[tuple[int, bytes | Status], None, None]:
                return run_on_cluster(
                    stub, _tasks(campaign, numbers), cluster.scheduler_address, LIMIT
                )

            def tell(row: JobRow) -> None:
                told.append(row)
                held.append(outstanding(cluster))
                if len(told) in (jobs // 10, jobs):
                    memory.append(resident_mib())

            began = time.process_time()
            carry_out(campaign, folder / "out", work, tell)
            together = time.process_time() - began
            left = len(cluster.scheduler.workers)
        same = contents(folder / "out") == contents(folder / "alone")
    once = sorted(row.object for row in told) == [row.object for row in rows]
    again = len(BEGAN) - len({number for number, _ in BEGAN})
    numbers = {
        "workers": workers,
        "left": left,
        "jobs": jobs,
        "again": again,
        "alone": alone,
        "together": together,
    }
    died = f"{workers - left} of {workers} workers died, each in the middle of a job; {again} jobs began again"
    each = f"{1e3 * together / jobs:.1f} ms of one processor with client, scheduler, workers and folder"
    return [
        Row(
            f"{jobs} jobs on {workers} workers, {dying} dying",
            "each file once, bytes as without deaths",
            f"{died}; every job was told and written once: {once}; equal bytes: {same}",
            once and same,
            numbers,
        ),
        Row(
            "overhead of a job",
            "-",
            f"{each}, {1e3 * alone / jobs:.1f} ms without Dask: {jobs / together:.0f} jobs a second at most",
            None,
            {"together": together / jobs, "alone": alone / jobs},
        ),
        Row(
            "growth of memory between a tenth of the jobs and all",
            "-",
            f"{memory[-1] - memory[0]:+.0f} MiB; at most {max(held)} tasks at once",
            None,
            {"memory": memory, "held": max(held)},
        ),
    ]


@bench("load/waiting")
def waiting(o: Options) -> list[Row]:
    """Submit jobs to a scheduler without workers; count the memory of Python objects in client and
    scheduler.
    """
    count = max(100, o.times(OUTSTANDING))
    spec = EvaluationSpec()
    protocol = PROTOCOLS["tabletop"]
    meta = {"campaign": "0" * 64, "versions": json.dumps(versions())}
    views = [
        ObjectView(Path("objects"), f"thing{j:06}", "view0", barrett().source) for j in range(count)
    ]
    with swarm(0) as cluster, Client(cluster, set_as_default=False) as client:
        gc.collect()
        tracemalloc.start()
        futures = [client.submit(run_job, view, protocol, spec, meta, pure=False) for view in views]
        while outstanding(cluster) < count:
            time.sleep(0.05)
        gc.collect()
        each = tracemalloc.get_traced_memory()[0] / count
        tracemalloc.stop()
        client.cancel(futures)
    text = (
        f"{each / 1024:.1f} KiB each, so {each * OUTSTANDING / 2**20:.0f} MiB for the {OUTSTANDING} that may wait,"
        f" and {each * MILLION / 2**30:.1f} GiB for a million"
    )
    return [Row(f"memory of {count} waiting jobs", "-", text, None, {"bytes": each})]


def stub(number: int, row: JobRow, meta: dict[str, str], alone: bool = False) -> bytes:
    """Return the file of a job without planning and trials: a random cloud without grasps."""
    if not alone:
        begin(number)
    rng = torch.Generator().manual_seed(number)
    points = torch.rand(POINTS, 3, generator=rng, dtype=torch.float64)
    row = row._replace(status=Status.NOT_CLOSED, points=POINTS)
    rows, records = empty_shard(row, barrett(), 1)
    return pack_shard(Shard(rows, dataclasses.replace(records, points=points)), meta)


@functools.cache
def barrett() -> Hand:
    """Return a hand, read once: its joints count in the shapes of empty records."""
    return load_hand("barrett")


def _tasks(campaign: Campaign, numbers: Sequence[int]) -> Iterator[tuple[Any, ...]]:
    return ((j, campaign.rows[j], campaign.meta) for j in numbers)


def _here(campaign: Campaign) -> Any:
    """Return the work of `carry_out` without Dask, in this process."""

    def work(numbers: Sequence[int]) -> Generator[tuple[int, bytes | Status], None, None]:
        tasks = ((*task, True) for task in _tasks(campaign, numbers))
        return run_as_they_end(stub, tasks, 0, LIMIT)

    return work


def contents(folder: Path) -> dict[str, bytes]:
    """Return every file below a folder by its path."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }
