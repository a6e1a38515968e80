"""A command that is told to end: what it held is let go, and its exit code says why."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.make import start_process

WAITING = """
import sys, time
from pathlib import Path
from torchgrasp.app import cli
from torchgrasp.files import hold_folder

def wait(out: Path) -> int:
    with hold_folder(out):
        print("ready", flush=True)
        time.sleep(600)
    return 0

cli.COMMANDS["wait"] = wait
cli.run_and_exit()
"""


@pytest.mark.promise("F6")
@pytest.mark.parametrize(("sign", "code", "said"), [("SIGINT", 130, "interrupted"), ("SIGTERM", 143, "terminated")])
def test_a_command_that_is_told_to_end_says_so_and_leaves_nothing(tmp_path: Path, sign: str, code: int, said: str):
    command = [sys.executable, "-c", WAITING, "wait", "--out", str(tmp_path / "out")]
    run = start_process(command, stdout=subprocess.PIPE)
    assert run.stdout is not None and run.stdout.readline() == "ready\n"
    run.send_signal(getattr(signal, sign))
    _, told = run.communicate()
    assert (run.returncode, told) == (code, f"torchgrasp: {said}\n")
    assert list(tmp_path.iterdir()) == []


ENDING = """
import atexit, sys, time
from torchgrasp.app import cli

def tell(word):
    print(word, flush=True)
    time.sleep(0.5)

def wait() -> int:
    try:
        tell("works")
        time.sleep(600)
    finally:
        tell("tidies")

def last() -> int:
    return 0

atexit.register(tell, "leaves")
cli.COMMANDS |= {"wait": wait, "last": last}
cli.run_and_exit()
"""


@pytest.mark.promise("F6")
@pytest.mark.parametrize(
    ("command", "code", "words", "said"),
    [("wait", 130, ["works", "tidies", "leaves"], "torchgrasp: interrupted\n"), ("last", 0, ["leaves"], "")],
)
def test_signals_do_not_disturb_an_end(command: str, code: int, words: list[str], said: str):
    """An impatient user sends both signals while the command tidies up, and while Python itself ends."""
    run = start_process([sys.executable, "-c", ENDING, command], stdout=subprocess.PIPE)
    assert run.stdout is not None
    for word in words:
        assert run.stdout.readline() == f"{word}\n"
        for sign in (signal.SIGINT, *([] if word == "works" else [signal.SIGTERM])):
            run.send_signal(sign)
    _, told = run.communicate()
    assert (run.returncode, told) == (code, said)


WORKING = """
import os, sys, time
from pathlib import Path
from torchgrasp.app import cli
from torchgrasp.jobs import run_tasks

def tell_and_sleep(path):
    Path(path + ".part").write_text(str(os.getpid()))
    os.rename(path + ".part", path)
    time.sleep(3600)

def work(out: Path) -> int:
    list(run_tasks(tell_and_sleep, [(str(out / name),) for name in "ab"], workers=2, limit=3600))
    return 0

if __name__ == "__main__":
    cli.COMMANDS["work"] = work
    cli.run_and_exit()
"""


@pytest.mark.promise("F6")
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize(("sign", "code", "said"), [("SIGINT", 130, "interrupted"), ("SIGTERM", 143, "terminated")])
def test_workers_that_are_told_to_end_with_their_command_say_nothing(tmp_path: Path, sign: str, code: int, said: str):
    """A terminal sends Ctrl-C to all processes of a command."""
    pytest.importorskip("pebble")
    (tmp_path / "script.py").write_text(WORKING)
    command = [sys.executable, str(tmp_path / "script.py"), "work", "--out", str(tmp_path)]
    run = start_process(command, start_new_session=True)
    marks = [tmp_path / "a", tmp_path / "b"]
    while run.poll() is None and not all(mark.exists() for mark in marks):
        time.sleep(0.05)
    workers = [int(mark.read_text()) for mark in marks]
    os.killpg(run.pid, getattr(signal, sign))
    _, told = run.communicate()
    assert (run.returncode, told) == (code, f"torchgrasp: {said}\n")
    while any(Path(f"/proc/{worker}").exists() for worker in workers):  # one that stayed ends the test by its time
        time.sleep(0.05)
