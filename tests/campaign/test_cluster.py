"""A real Dask cluster of processes on this machine: a worker is killed, versions differ, nobody answers."""

import os
import signal
import threading
import time
from pathlib import Path

import pytest

from tests.campaign.cheap import campaign, cheap_job, contents, die_at, wait_at, work_on
from tests.campaign.conftest import QUICK
from torchgrasp import load_hand
from torchgrasp.campaign import run_campaign
from torchgrasp.campaign.cluster import run_on_cluster
from torchgrasp.campaign.folder import carry_out
from torchgrasp.errors import BadArgument, MissingExtra, Status

distributed = pytest.importorskip("distributed")
JOBS = 17


@pytest.fixture(scope="module")
def address():
    """The address of a scheduler with two worker processes, which come back when they die."""
    import dask

    quiet = {"distributed.logging.distributed": "critical", "distributed.scheduler.allowed-failures": 1}
    with (
        dask.config.set(quiet),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=60
        ) as cluster,
    ):
        yield cluster.scheduler_address


@pytest.mark.promise("F4")
@pytest.mark.filterwarnings("ignore")
def test_a_worker_killed_in_the_middle_changes_no_byte_and_a_deadly_job_is_named(address, tmp_path: Path):
    asked, marks, killed = campaign(JOBS), tmp_path / "marks", []
    marks.mkdir()
    carry_out(asked, tmp_path / "whole", work_on(asked, 0))

    def kill() -> None:
        while not killed:
            time.sleep(0.02)
            for mark in list(marks.iterdir())[:1]:
                os.kill(int(mark.name), signal.SIGKILL)
                killed.append(mark.name)

    def work(numbers):
        tasks = [(j, asked.rows[j], asked.meta, 0.1, str(marks)) for j in numbers]
        return run_on_cluster(cheap_job, tasks, address, 60.0)

    threading.Thread(target=kill, daemon=True).start()
    carry_out(asked, tmp_path / "out", work)
    assert killed and contents(tmp_path / "out") == contents(tmp_path / "whole")

    tasks = [(j, asked.rows[j], asked.meta, 3) for j in (1, 3, 4)]
    ended = dict(run_on_cluster(die_at, tasks, address, 60.0))
    assert [type(ended[k]) for k in range(3)] == [bytes, Status, bytes] and ended[1] is Status.WORKER_DIED


@pytest.mark.promise("F5")
@pytest.mark.filterwarnings("ignore")
def test_a_late_job_is_named_and_costs_no_other(address, tmp_path: Path):
    asked = campaign(2)
    tasks = [(j, asked.rows[j], asked.meta, 1, str(tmp_path / "never")) for j in (0, 1)]
    ended = dict(run_on_cluster(wait_at, tasks, address, 1.0))
    assert isinstance(ended[0], bytes) and ended[1] is Status.TIMED_OUT


@pytest.mark.filterwarnings("ignore")
def test_an_error_of_a_job_comes_when_it_ends(address):
    with pytest.raises(ZeroDivisionError):
        list(run_on_cluster(divmod, [(7, 2), (7, 0), (9, 2)], address, 60.0))
    assert dict(run_on_cluster(divmod, [(7, 2), (9, 2)], address, 60.0)) == {0: (3, 1), 1: (4, 1)}


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
def test_an_object_is_planned_on_and_lifted_by_workers_as_here(address, carton: Path, data: Path, tmp_path: Path):
    pytest.importorskip("sapien")
    assert len(run_campaign(carton, load_hand("barrett"), tmp_path / "there", QUICK, address)) == 2
    assert contents(tmp_path / "there") == contents(data)


@pytest.mark.filterwarnings("ignore")
def test_no_scheduler_and_no_dask_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("torchgrasp.campaign.cluster.CONNECTING", "1s")
    with pytest.raises(BadArgument, match=r"workers: expected .*got 'tcp://127\.0\.0\.1:1'"):
        list(run_on_cluster(divmod, [(7, 2)], "tcp://127.0.0.1:1", 1.0))
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(MissingExtra, match=r"torchgrasp\[cluster\]"):
        list(run_on_cluster(divmod, [(7, 2)], "tcp://127.0.0.1:1", 1.0))
