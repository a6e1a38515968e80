"""A command that is told to end: what it held is let go, and its exit code says why."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

WAITING = """
import sys, time
from pathlib import Path
from torchgrasp import cli
from torchgrasp.files import hold_folder

def wait(out: Path) -> int:
    with hold_folder(out):
        print("ready", flush=True)
        time.sleep(600)
    return 0

cli.COMMANDS["wait"] = wait
sys.exit(cli.main(["wait", "--out", sys.argv[1]]))
"""


@pytest.mark.parametrize(("sign", "code", "said"), [("SIGINT", 130, "interrupted"), ("SIGTERM", 143, "terminated")])
def test_a_command_that_is_told_to_end_says_so_and_leaves_nothing(tmp_path: Path, sign: str, code: int, said: str):
    command = [sys.executable, "-c", WAITING, str(tmp_path / "out")]
    # a shell's background processes ignore SIGINT, and their children inherit that
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    finally:
        signal.signal(signal.SIGINT, before)
    assert run.stdout is not None and run.stdout.readline() == "ready\n"
    run.send_signal(getattr(signal, sign))
    _, told = run.communicate()
    assert (run.returncode, told) == (code, f"torchgrasp: {said}\n")
    assert list(tmp_path.iterdir()) == []
