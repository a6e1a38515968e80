"""A standard output that is full or closed."""

import os
import subprocess
import sys

import pytest

LIST = [sys.executable, "-c", "import sys; from torchgrasp.cli import main; sys.exit(main(['objects']))"]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="the system has no /dev/full")
def test_a_full_disk_behind_stdout_is_named():
    with open("/dev/full", "w") as full:
        run = subprocess.run(LIST, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (run.returncode, run.stderr) == (2, "torchgrasp: [Errno 28] No space left on device\n")


@pytest.mark.skipif(sys.platform == "win32", reason="a POSIX shell closes the stream")
def test_without_stdout_a_command_does_its_work():
    run = subprocess.run(["sh", "-c", '"$@" >&-', "sh", *LIST], stderr=subprocess.PIPE, text=True)
    assert (run.returncode, run.stderr) == (0, "")
