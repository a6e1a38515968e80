"""A command that is told to end lets go of what it held and says why; standard streams may be full
or closed.
"""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.make import start_process
from torchgrasp.app import cli

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows forks no processes")

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
    [
        ("wait", 130, ["works", "tidies", "leaves"], "torchgrasp: interrupted\n"),
        ("last", 0, ["leaves"], ""),
    ],
)
def test_signals_do_not_disturb_an_end(command: str, code: int, words: list[str], said: str):
    """An impatient user sends both signals while the command tidies up, and while Python itself
    ends.
    """
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
from collections.abc import Callable
from pathlib import Path
from torchgrasp.files import hold_folder
from torchgrasp.foundation.jobs import run_tasks

def tell_and_sleep(path):
    Path(path + ".part").write_text(str(os.getpid()))
    os.rename(path + ".part", path)
    time.sleep(3600)

def work(out: Path) -> int:
    with hold_folder(out):
        list(run_tasks(tell_and_sleep, [(str(out.parent / "mark"),)], workers=1, limit=3600))
    return 0

if __name__ == "__main__":
    from torchgrasp.app import cli
    cli.COMMANDS["work"] = work
    cli.run_and_exit()
"""


@pytest.mark.promise("F6")
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize(
    ("send", "sign", "code", "said"),
    [
        ("killpg", "SIGINT", 130, "interrupted"),
        ("kill", "SIGTERM", 143, "terminated"),
    ],
)
def test_a_command_that_is_told_to_end_says_so_alone_and_leaves_nothing(
    tmp_path: Path, send: str, sign: str, code: int, said: str
):
    """A terminal sends Ctrl-C to all processes of a command; its worker says nothing, and its
    folder is let go.
    """
    pytest.importorskip("pebble")
    script = tmp_path / "script.py"
    mark = tmp_path / "mark"
    script.write_text(WORKING)
    command = [sys.executable, str(script), "work", "--out", str(tmp_path / "out")]
    run = start_process(command, start_new_session=True)
    while run.poll() is None and not mark.exists():
        time.sleep(0.05)
    getattr(os, send)(
        run.pid, getattr(signal, sign)
    )  # to all processes of the command, or to the command alone
    _, told = run.communicate()
    assert (run.returncode, told) == (code, f"torchgrasp: {said}\n")
    assert sorted(tmp_path.iterdir()) == [mark, script]
    while Path(
        f"/proc/{mark.read_text()}"
    ).exists():  # a worker that stayed ends the test by its time
        time.sleep(0.05)


STREAMS = "stdin", "stdout", "stderr"


def exit_code_without(closed: set[int], act: Callable[[], int]) -> int | None:
    """Return what an action returns in a child whose standard streams are open but for some."""

    def work() -> None:
        for stream, name in enumerate(STREAMS):
            file = os.open(os.devnull, os.O_RDWR)
            os.dup2(file, stream)
            os.close(file)
            setattr(sys, name, open(stream, "r" if stream == 0 else "w", closefd=False))
        for stream in closed:
            os.close(stream)
            setattr(sys, STREAMS[stream], None)  # as Python itself does when it starts
        os._exit(act())

    child = multiprocessing.get_context("fork").Process(target=work)
    child.start()
    child.join()
    return child.exitcode


@pytest.mark.promise("F3")
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="the system has no /dev/full")
def test_a_full_disk_behind_stdout_is_named():
    script = "import sys; from torchgrasp.app.cli import main; sys.exit(main(['objects']))"
    with open("/dev/full", "w") as full:
        run = subprocess.run(
            [sys.executable, "-c", script], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert (run.returncode, run.stderr) == (2, "torchgrasp: [Errno 28] No space left on device\n")


def test_without_stdout_a_command_does_its_work():
    assert exit_code_without({1}, lambda: cli.main(["objects"])) == 0


@pytest.mark.parametrize("closed", [{2}, {1, 2}, {0, 1, 2}])
def test_without_streams_a_command_ends_as_with_them_and_no_file_takes_their_place(closed):
    """A command is refused; then a file is opened, which may be no standard stream: libraries print
    into those.
    """

    def act() -> int:
        code = cli.main(["cloud", "check", "none.ply"])
        return 10 * code + (os.open(os.devnull, os.O_RDONLY) > 2)

    assert exit_code_without(closed, act) == 21
