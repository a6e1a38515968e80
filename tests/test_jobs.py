"""Worker processes that hang, die and raise; what a caller sees, and what is left behind."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time

import pytest
import torch

from torchgrasp.errors import BadArgument, Status
from torchgrasp.jobs import run_as_they_end, run_tasks

pytest.importorskip("pebble")


def act(what: str, value: int = 0) -> object:
    """Return a square, soon or later, hang, die in one of two ways, raise, or report the threads."""
    if what == "hang":
        time.sleep(600)
    if what == "slow":
        time.sleep(1)
    if what == "exit":
        os._exit(3)
    if what == "KILL":
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "raise":
        raise BadArgument("value", value, "another")
    if what == "threads":
        return torch.get_num_threads()
    return value * value


def die_once(path: str) -> str:
    """Die at the first call, and leave a file that tells the second."""
    if not os.path.exists(path):
        open(path, "w").close()
        os.kill(os.getpid(), signal.SIGKILL)
    return "survived"


@pytest.mark.promise("F4", "F5")
def test_a_failure_costs_its_own_task_alone_and_the_order_stays():
    bad = {2: "KILL", 4: "hang", 5: "exit"}
    found = list(run_tasks(act, [(bad.get(i, "square"), i) for i in range(12)], workers=2, limit=3.0))
    expected = {i: Status.TIMED_OUT if what == "hang" else Status.WORKER_DIED for i, what in bad.items()}
    assert found == [expected.get(i, i * i) for i in range(12)]


@pytest.mark.promise("F4")
def test_a_death_that_is_not_the_tasks_own_is_forgiven(tmp_path):
    assert list(run_tasks(die_once, [(str(tmp_path / "mark"),)], workers=1)) == ["survived"]


@pytest.mark.promise("F4")
def test_a_task_whose_worker_died_goes_before_those_that_wait(tmp_path):
    tasks = [(str(tmp_path / "mark"),), *((str(tmp_path),) for _ in range(7))]
    found = list(run_as_they_end(die_once, tasks, 1, 60.0))
    numbers = [number for number, result in found if result == "survived"]
    assert sorted(numbers) == list(range(8)) and numbers.index(0) <= 2


def test_a_task_that_ends_early_waits_for_its_turn_or_not(tmp_path):
    tasks = [("slow", 5), ("square", 3), ("square", 4)]
    assert list(run_tasks(act, tasks, workers=2)) == [25, 9, 16]
    assert [number for number, _ in run_as_they_end(act, tasks, 2, 60.0)][-1] == 0


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


class Heavy:
    """A task whose workers die while they begin, as many times as the folder has no mark."""

    def __init__(self, folder: str, deaths: int) -> None:
        self.folder, self.deaths = folder, deaths

    def __call__(self, value: int) -> int:
        return value * value

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__ |= state
        if multiprocessing.parent_process() is not None:
            number = len(os.listdir(self.folder))
            if number < self.deaths:
                open(os.path.join(self.folder, str(number)), "w").close()
                os._exit(7)


@pytest.mark.promise("F4")
def test_workers_that_die_before_they_take_a_task_are_replaced(tmp_path):
    assert list(run_tasks(Heavy(str(tmp_path), 1), [(2,), (3,)], workers=1)) == [4, 9]


@pytest.mark.promise("F4")
def test_workers_that_always_die_before_they_take_a_task_end(tmp_path):
    assert list(run_tasks(Heavy(str(tmp_path), 1000), [(2,), (3,)], workers=1)) == [Status.WORKER_DIED] * 2


def test_an_error_comes_when_its_turn_comes_and_workers_have_one_thread():
    results = run_tasks(act, [("threads",), ("raise", 5), ("square", 2)], workers=2)
    assert next(results) == 1
    with pytest.raises(BadArgument, match=r"value: expected .*got 5"):
        next(results)


def test_bad_arguments_are_named_at_once():
    with pytest.raises(BadArgument, match="workers"):
        run_tasks(act, [], workers=-1)
    with pytest.raises(BadArgument, match="limit"):
        run_tasks(act, [], limit=float("nan"))


SCRIPT = """
import os, signal, sys, time
from pathlib import Path
from torchgrasp.jobs import run_tasks

def tell_and_sleep(path):
    Path(path + ".part").write_text(str(os.getpid()))
    os.rename(path + ".part", path)
    time.sleep(3600)

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background processes ignore it
    list(run_tasks(tell_and_sleep, [(path,) for path in sys.argv[1:]], workers=2, limit=3600))
"""


@pytest.mark.promise("F6")
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGKILL])
def test_no_worker_outlives_the_run(tmp_path, sign):
    """The signal comes when both workers are at work, and the test ends when both are gone, however long that takes."""
    script, marks = tmp_path / "script.py", [tmp_path / "first", tmp_path / "second"]
    script.write_text(SCRIPT)
    with subprocess.Popen([sys.executable, script, *marks], stderr=subprocess.DEVNULL) as child:
        wait_until(lambda: all(mark.exists() for mark in marks) or child.poll() is not None)
        workers = [int(mark.read_text()) for mark in marks]
        assert all(alive(pid) for pid in workers)
        child.send_signal(sign)
        wait_until(lambda: child.poll() is not None)
        assert child.returncode != 0
    wait_until(lambda: not any(alive(pid) for pid in workers))


def wait_until(happened):
    """Wait for a state; what never comes about ends the test after a quarter of an hour."""
    deadline = time.monotonic() + 900
    while not happened():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def alive(pid: int) -> bool:
    """Tell whether a process is there and no zombie."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False
