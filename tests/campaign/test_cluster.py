"""A real Dask cluster, of processes or of many workers in this one: workers die, plan for others,
nobody answers.
"""

import dataclasses
import json
import multiprocessing
import os
import shutil
import signal
import threading
import time
from collections import Counter
from multiprocessing import forkserver
from pathlib import Path

import pytest

from tests.campaign.cheap import (
    campaign,
    cheap_job,
    contents,
    die_at,
    seen_job,
    seen_plan,
    wait_at,
    work_on,
)
from tests.campaign.conftest import QUICK
from tests.campaign.swarm import BEGAN, FATAL, outstanding, swarm
from tests.make import same_bits
from torchgrasp import load_hand
from torchgrasp.campaign import campaign as run_module
from torchgrasp.campaign import cluster as cluster_module
from torchgrasp.campaign import folder as folder_module
from torchgrasp.campaign import run_campaign
from torchgrasp.campaign.cluster import OnGpu, run_on_cluster
from torchgrasp.campaign.folder import carry_out
from torchgrasp.campaign.job import plan_jobs
from torchgrasp.data import read_shards
from torchgrasp.foundation.errors import BadArgument, MissingExtra, OutputError, Status

distributed = pytest.importorskip("distributed")
JOBS = 17


@pytest.fixture(scope="module")
def address():
    """The address of a scheduler with two worker processes, which come back when they die: each is
    forked from one that has imported what its jobs need.
    """
    import dask

    forking = multiprocessing.get_context("forkserver")
    forking.set_forkserver_preload(["distributed", "tests.campaign.cheap", "torchgrasp.campaign"])
    forkserver.ensure_running()
    quiet = {
        "distributed.worker.multiprocessing-method": "forkserver",
        "distributed.logging.distributed": "critical",
        "distributed.scheduler.allowed-failures": 1,
    }
    with (
        dask.config.set(quiet),
        distributed.LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            processes=True,
            dashboard_address=None,
            silence_logs=60,
        ) as cluster,
    ):
        yield cluster.scheduler_address


@pytest.mark.promise("F4")
@pytest.mark.filterwarnings("ignore")
def test_a_worker_killed_in_the_middle_changes_no_byte_and_a_deadly_job_is_named(
    address, tmp_path: Path
):
    asked = campaign(JOBS)
    marks = tmp_path / "marks"
    killed = []
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
    assert [type(ended[k]) for k in range(3)] == [bytes, Status, bytes] and ended[
        1
    ] is Status.WORKER_DIED


@pytest.mark.promise("F5")
@pytest.mark.filterwarnings("ignore")
def test_a_late_job_is_named_and_costs_no_other(address, tmp_path: Path):
    asked = campaign(2)
    tasks = [(j, asked.rows[j], asked.meta, 1, str(tmp_path / "never")) for j in (0, 1)]
    ended = dict(
        run_on_cluster(wait_at, tasks, address, 5.0)
    )  # a busy worker may need seconds for the first
    assert isinstance(ended[0], bytes) and ended[1] is Status.TIMED_OUT


@pytest.mark.filterwarnings("ignore")
def test_an_error_of_a_job_comes_when_it_ends(address):
    with pytest.raises(ZeroDivisionError):
        list(run_on_cluster(divmod, [(7, 2), (7, 0), (9, 2)], address, 60.0))
    assert dict(run_on_cluster(divmod, [(7, 2), (9, 2)], address, 60.0)) == {0: (3, 1), 1: (4, 1)}


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
def test_an_object_is_planned_on_and_lifted_by_workers_as_here(
    address, carton: Path, data: Path, tmp_path: Path
):
    pytest.importorskip("sapien")
    assert len(run_campaign(carton, load_hand("barrett"), tmp_path / "there", QUICK, address)) == 2
    assert contents(tmp_path / "there") == contents(data)


@pytest.mark.filterwarnings("ignore")
def test_no_scheduler_and_no_dask_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("torchgrasp.campaign.cluster.CONNECTING", "200ms")
    with pytest.raises(BadArgument, match=r"workers: expected .*got 'tcp://127\.0\.0\.1:1'"):
        list(run_on_cluster(divmod, [(7, 2)], "tcp://127.0.0.1:1", 1.0))
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(MissingExtra, match=r"torchgrasp\[cluster\]"):
        list(run_on_cluster(divmod, [(7, 2)], "tcp://127.0.0.1:1", 1.0))


@pytest.fixture
def sixteen():
    """Sixteen workers in this process."""
    with swarm(16) as cluster:
        yield cluster


@pytest.fixture
def few():
    """Three workers in this process."""
    with swarm(3) as cluster:
        yield cluster


@pytest.mark.promise("F4")
@pytest.mark.filterwarnings("ignore")
def test_four_of_sixteen_workers_die_and_every_job_is_written_once(
    sixteen, tmp_path: Path, monkeypatch
):
    """The scheduler gives the jobs of the dead to others. No more jobs than it may hold are
    submitted and not yet yielded, and it holds no other.
    """
    jobs = 50
    most = 20
    submitted = 0
    yielded = 0
    written = Counter[str]()
    asked = campaign(jobs, 16)
    write = folder_module.write_file
    monkeypatch.setattr(
        folder_module, "write_file", lambda path, x: written.update([path.name]) or write(path, x)
    )
    monkeypatch.setattr(cluster_module, "OUTSTANDING", most)
    FATAL.update(dict.fromkeys((1, 15, 30, 49), sixteen))

    def work(numbers):
        def tasks():
            nonlocal submitted
            for j in numbers:
                submitted += 1
                yield j, asked.rows[j], asked.meta

        nonlocal yielded
        for ended in run_on_cluster(seen_job, tasks(), sixteen.scheduler_address, 60.0):
            yielded += 1
            left = min(most, len(numbers) - yielded)
            assert submitted - yielded == left
            assert outstanding(sixteen, left) <= left
            yield ended

    carry_out(asked, tmp_path / "out", work)
    assert len(sixteen.scheduler.workers) == 12 and not FATAL and yielded == jobs - 1
    tries = Counter(number for number, _ in BEGAN)
    assert {number for number, n in tries.items() if n > 1} >= {1, 15, 30, 49}
    assert set(tries) == set(range(jobs)) - {2}  # which is refused before any work
    assert {name: n for name, n in written.items() if name.startswith("job")} == {
        f"job-{j:06}.safetensors": 1 for j in range(jobs)
    }
    carry_out(asked, tmp_path / "whole", work_on(asked, 0))
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


@pytest.mark.promise("F4")
@pytest.mark.filterwarnings("ignore")
def test_a_worker_with_a_gpu_plans_for_a_shard_and_another_one_if_it_dies(sixteen, tmp_path: Path):
    asked = campaign(64, 16)
    size = 16
    with_gpu = list(sixteen.workers.values())[:3]
    for worker in with_gpu:
        sixteen.sync(worker.set_resources, GPU=1)
    FATAL[-1 - 16] = sixteen

    def work(numbers):
        shards = {k: OnGpu(seen_plan, ([*range(k * size, (k + 1) * size)],)) for k in range(4)}
        tasks = ((j, asked.rows[j], asked.meta, shards[j // size]) for j in numbers)
        return run_on_cluster(seen_job, tasks, sixteen.scheduler_address, 60.0)

    carry_out(asked, tmp_path / "out", work)
    plans = [(number, where) for number, where in BEGAN if number < 0]
    assert {where for _, where in plans} <= {worker.address for worker in with_gpu}
    assert {number for number, _ in plans} == {-1, -17, -33, -49} and 5 <= len(plans) <= 8
    carry_out(asked, tmp_path / "whole", work_on(asked, 0))
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
def test_plans_of_a_batch_are_tried_and_say_their_device(
    few, carton: Path, data: Path, tmp_path: Path, monkeypatch
):
    """The processor stands for the GPU: the records of the only sound view are those of its plan
    alone.
    """
    objects = tmp_path / "objects"
    out = tmp_path / "out"
    spec = dataclasses.replace(QUICK, device="cuda")
    shutil.copytree(carton, objects)
    entries = json.loads((objects / "manifest.json").read_text())["objects"]
    (objects / "manifest.json").write_text(
        json.dumps({"objects": entries | {"a gone one": entries["carton"]}})
    )
    few.sync(next(iter(few.workers.values())).set_resources, GPU=1)
    monkeypatch.setattr(run_module, "plan_jobs", lambda *task: plan_jobs(*task[:-1], "cpu"))
    run_campaign(objects, load_hand("barrett"), out, spec, few.scheduler_address)
    gone, there = (read_shards(out).job(j) for j in (0, 1))
    alone = read_shards(data).job(0)
    assert gone.row.status is Status.BAD_OBJECT and "no file" in gone.row.note
    assert same_bits(there.grasps, alone.grasps) and there.passed.equal(alone.passed)
    assert there.row._replace(meta=alone.row.meta) == alone.row
    assert (
        there.row.meta == alone.row.meta | {"device": "cpu"}
        and "planned on cuda" in (out / "README.md").read_text()
    )
    with pytest.raises(OutputError, match="other campaigns"):
        run_campaign(objects, load_hand("barrett"), out, QUICK)
    with pytest.raises(BadArgument, match="workers"):
        run_campaign(objects, load_hand("barrett"), tmp_path / "other", spec, 1)
