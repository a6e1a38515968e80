"""Standard streams that are full or closed."""

import os
import subprocess
import sys

import pytest

LIST = [sys.executable, "-c", "import sys; from torchgrasp.app.cli import main; sys.exit(main(['objects']))"]


@pytest.mark.promise("F3")
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="the system has no /dev/full")
def test_a_full_disk_behind_stdout_is_named():
    with open("/dev/full", "w") as full:
        run = subprocess.run(LIST, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (run.returncode, run.stderr) == (2, "torchgrasp: [Errno 28] No space left on device\n")


@pytest.mark.skipif(sys.platform == "win32", reason="a POSIX shell closes the stream")
def test_without_stdout_a_command_does_its_work():
    run = subprocess.run(["sh", "-c", '"$@" >&-', "sh", *LIST], stderr=subprocess.PIPE, text=True)
    assert (run.returncode, run.stderr) == (0, "")


CLOSED = """
import os, sys
from torchgrasp.app import cli
code = cli.main(["cloud", "check", "none.ply"])
file = os.open(os.devnull, os.O_RDONLY)
sys.exit(10 * code + (file > 2))
"""
"""A command that is refused; then a file is opened, which may be no standard stream: libraries print into those."""


@pytest.mark.skipif(sys.platform == "win32", reason="a POSIX shell closes the streams")
@pytest.mark.parametrize("closed", ["2>&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_without_streams_a_command_ends_as_with_them_and_no_file_takes_their_place(closed):
    command = ["sh", "-c", f'exec "$@" {closed}', "sh", sys.executable, "-c", CLOSED]
    run = subprocess.run(command, capture_output=True, stdin=subprocess.DEVNULL, text=True)
    assert (run.returncode, run.stdout, run.stderr) == (21, "", "")
