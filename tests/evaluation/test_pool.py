"""Worker processes that hang, die and raise; what a caller sees, and what is left behind."""

import os
import signal
import subprocess
import sys
import time

import pytest
import torch

from torchgrasp.errors import BadArgument, Status
from torchgrasp.evaluation.pool import run_tasks

pytest.importorskip("pebble")


def act(what: str, value: int = 0) -> object:
    """Do well, hang, die in one of two ways, raise, or tell about the process."""
    if what == "hang":
        time.sleep(600)
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


def test_f4_f5_a_failure_costs_its_own_task_alone_and_the_order_stays():
    bad = {2: "KILL", 4: "hang", 5: "exit"}
    found = list(run_tasks(act, [(bad.get(i, "square"), i) for i in range(12)], workers=2, limit=1.0))
    expected = {i: Status.TIMED_OUT if what == "hang" else Status.WORKER_DIED for i, what in bad.items()}
    assert found == [expected.get(i, i * i) for i in range(12)]


def test_f4_a_death_that_is_not_the_tasks_own_is_forgiven(tmp_path):
    assert list(run_tasks(die_once, [(str(tmp_path / "mark"),)], workers=1)) == ["survived"]


def test_an_error_comes_when_its_turn_comes_and_workers_have_one_thread():
    results = run_tasks(act, [("threads",), ("raise", 5), ("square", 2)], workers=2)
    assert next(results) == 1
    with pytest.raises(BadArgument, match="value: found 5"):
        next(results)


def test_bad_arguments_are_named_at_once():
    with pytest.raises(BadArgument, match="workers"):
        run_tasks(act, [], workers=-1)
    with pytest.raises(BadArgument, match="limit"):
        run_tasks(act, [], limit=float("nan"))


SCRIPT = """
import multiprocessing, sys, time
from torchgrasp.evaluation.pool import run_tasks

if __name__ == "__main__":
    results = run_tasks(time.sleep, [(0,), (600,), (600,)], workers=2)
    next(results)
    print(*[child.pid for child in multiprocessing.active_children()], flush=True)
    next(results)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGKILL])
def test_f6_no_worker_outlives_the_run(tmp_path, sign):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as child:
        assert child.stdout is not None
        workers = [int(pid) for pid in child.stdout.readline().split()]
        assert len(workers) == 2 and all(alive(pid) for pid in workers)
        child.send_signal(sign)
        assert child.wait(20) != 0
    for _ in range(100):
        if not any(alive(pid) for pid in workers):
            return
        time.sleep(0.1)
    raise AssertionError("a worker lives on")


def alive(pid: int) -> bool:
    """Tell whether a process is there and no zombie."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False
