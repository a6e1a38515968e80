"""Worker processes that hang, die and raise; what a caller sees, and what is left behind."""

import pickle
import signal

import pytest
import torch

from tests.make import run_python
from tests.tasks import Heavy, act, die_once, spin
from torchgrasp.foundation.errors import BadArgument, NoWorkers, Status
from torchgrasp.foundation.jobs import pack, run_as_they_end, run_tasks, unpack
from torchgrasp.planner.schedule import BatchSize
from torchgrasp.values.planning import PointCloud

pytest.importorskip("pebble")


@pytest.mark.promise("F5")
@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="no timer of processor time")
def test_the_limit_is_of_processor_time_so_that_a_task_that_only_waits_for_its_turn_is_not_late():
    tasks = [("pause", 700), ("work", 1), ("pause", 700), ("square", 3)]
    found = list(run_tasks(act, tasks, workers=2, limit=0.4))
    assert found == [700**2, Status.TIMED_OUT, 700**2, 9]


@pytest.mark.promise("F5")
@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="no timer of processor time")
def test_the_time_of_a_task_is_its_own():
    """Each of the tasks takes more than half of the limit, all in one process."""
    assert list(run_tasks(spin, [(0.2, k) for k in range(4)], workers=1, limit=0.35)) == [*range(4)]


@pytest.mark.promise("F4", "F5")
def test_a_failure_costs_its_own_task_alone_and_the_order_stays():
    bad = {2: "exit", 4: "hang"}
    found = list(
        run_tasks(act, [(bad.get(i, "square"), i) for i in range(12)], workers=2, limit=0.2)
    )
    expected = {
        i: Status.TIMED_OUT if what == "hang" else Status.WORKER_DIED for i, what in bad.items()
    }
    assert found == [expected.get(i, i * i) for i in range(12)]


@pytest.mark.promise("F4")
def test_a_death_that_is_not_the_tasks_own_is_forgiven_and_the_task_goes_before_those_that_wait(
    tmp_path,
):
    tasks = [(str(tmp_path / "mark"),), *((str(tmp_path),) for _ in range(7))]
    found = list(run_as_they_end(die_once, tasks, 1, 60.0))
    numbers = [number for number, result in found if result == "survived"]
    assert sorted(numbers) == list(range(8)) and numbers.index(0) <= 2


def test_a_task_that_ends_early_waits_for_its_turn_as_an_error_does_and_workers_have_one_thread():
    results = run_tasks(
        act, [("slow", 5), ("square", 3), ("threads",), ("raise", 5), ("square", 2)], workers=2
    )
    assert [next(results) for _ in range(3)] == [25, 9, 1]
    with pytest.raises(BadArgument, match=r"value: expected .*got 5"):
        next(results)


def test_here_a_task_has_one_thread_and_the_caller_its_own():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        for _ in range(2):
            results = run_tasks(act, [("threads",), ("raise", 5)], workers=0)
            assert next(results) == 1 and torch.get_num_threads() == 2
            with pytest.raises(BadArgument):
                next(results)
            assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


@pytest.mark.promise("F4")
def test_workers_that_die_before_they_take_a_task_are_replaced(tmp_path):
    assert list(run_tasks(Heavy(str(tmp_path), 1), [(2,), (3,)], workers=1)) == [4, 9]


@pytest.mark.promise("F4")
def test_workers_that_always_die_before_they_take_a_task_are_one_error_however_many_the_tasks(
    tmp_path,
):
    with pytest.raises(NoWorkers, match=r"no worker process can start.*__main__"):
        list(run_tasks(Heavy(str(tmp_path), 1000), [(2,)] * 50, workers=1))


SCRIPT = """
from torchgrasp.foundation.jobs import run_tasks
print("once", flush=True)
print(list(run_tasks(pow, [(3, 2), (4, 2)], workers=1)))
"""


@pytest.mark.parametrize("way", ["file", "stdin"])
def test_a_script_without_a_guard_runs_once_and_its_workers_work(way, tmp_path):
    (path := tmp_path / "script.py").write_text(SCRIPT)
    found = run_python(str(path)) if way == "file" else run_python("-", given=SCRIPT)
    assert found.stdout == "once\n[9, 16]\n" and not found.stderr


def test_bad_arguments_are_named_at_once():
    with pytest.raises(BadArgument, match="workers"):
        run_tasks(act, [], workers=-1)
    with pytest.raises(BadArgument, match="limit"):
        run_tasks(act, [], limit=float("nan"))


def test_a_packed_value_holds_no_tensor_and_unpacks_to_the_same_value_with_its_cached_attributes():
    cloud = PointCloud(torch.rand(5, 3), None, torch.zeros(3))
    vars(cloud)["cached"] = torch.arange(3)
    value = {
        "clouds": [cloud, cloud],
        "batch": BatchSize(4, 2),
        "pair": (torch.tensor(2.5), "text"),
        "class": PointCloud,
    }
    sent = pack(value)
    assert sent["clouds"][0] is sent["clouds"][1]  # what is held twice is sent once
    packed = pickle.dumps(sent)
    assert b"torch.Tensor" not in packed and b"_rebuild_tensor" not in packed
    found = unpack(pickle.loads(packed))  # noqa: S301
    assert (
        torch.equal(found["clouds"][1].points, cloud.points) and found["clouds"][0].normals is None
    )
    assert (
        torch.equal(found["clouds"][0].cached, torch.arange(3))
        and type(found["clouds"][0]) is PointCloud
    )
    assert found["batch"] == BatchSize(4, 2) and isinstance(found["batch"], BatchSize)
    assert (
        found["pair"][0].shape == ()
        and float(found["pair"][0]) == 2.5
        and found["pair"][1] == "text"
    )
    assert found["class"] is PointCloud
