"""A Dask cluster whose many workers live in this process, so that some can die while the real
scheduler looks on.
"""

import contextlib
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import dask
from distributed import Client, LocalCluster, get_worker

QUIET = {
    "distributed.logging.distributed": "critical",
    "distributed.admin.tick.interval": "10 minutes",
    "distributed.admin.tick.cycle": "10 minutes",
    "distributed.admin.system-monitor.interval": "10 minutes",
    "distributed.worker.profile.enabled": False,
}
"""Every worker looks after its process many times a second; a thousand of them in one process would
do nothing else.
"""
BEGAN: list[tuple[int, str]] = []
"""Number of each job that a worker began, in order, and the worker's address."""
FATAL: dict[int, LocalCluster] = {}
"""Jobs in the middle of which their worker dies once, and its cluster."""
THREADS = (
    4  # that do the jobs of all workers: a thread for each would mostly wait for Python's lock
)


class SharedThreadPoolExecutor(ThreadPoolExecutor):
    """Threads of all workers, which outlive each of them; Dask knows them by this name."""

    def shutdown(self, wait: bool = True, **_: Any) -> None:
        """Leave the threads to the other workers."""


@contextlib.contextmanager
def swarm(workers: int) -> Iterator[LocalCluster]:
    """Start a scheduler, and workers that answer it one by one; a worker that dies is not replaced."""
    BEGAN.clear()
    pool = SharedThreadPoolExecutor(THREADS)
    with (
        dask.config.set(QUIET),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=False,
            dashboard_address=None,
            silence_logs=60,
            memory_limit=0,
            executor=pool,
        ) as cluster,
        Client(
            cluster, set_as_default=True
        ),  # for the workers, which else share the client of one that may die
    ):
        yield cluster
    ThreadPoolExecutor.shutdown(pool, cancel_futures=True)


def begin(number: int) -> str:
    """Write down that a job began, and kill its worker if that is its fate; return the worker's
    address.
    """
    address = get_worker().address
    BEGAN.append((number, address))
    if number in FATAL:
        kill(FATAL.pop(number), address)
    return address


def kill(cluster: LocalCluster, address: str) -> None:
    """Cut the line of a worker to the scheduler, as the end of its process does; results that it
    had are lost.
    """

    async def cut() -> None:
        (worker,) = (worker for worker in cluster.workers.values() if worker.address == address)
        worker.batched_stream.comm.abort()

    cluster.sync(cut)


def outstanding(cluster: LocalCluster, most: int) -> int:
    """Return how many tasks the scheduler holds, once it has at most so many.

    What a client tells it arrives later, and not in order: a result may leave after the next task
    has come. A scheduler that keeps more ends the test by its time.
    """
    while len(cluster.scheduler.tasks) > most:
        time.sleep(0.01)
    return len(cluster.scheduler.tasks)
