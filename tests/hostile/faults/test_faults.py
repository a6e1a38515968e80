"""At each of its calls that change the disk a command is killed, told to end, or refused: it is
continued all the same.

Some calls of each command are tried; `--hypothesis-profile=long` tries all.
"""

import contextlib
import errno
import io
import os
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.campaign.cheap import contents
from tests.hostile.faults.commands import COMMANDS, Command
from tests.hostile.faults.inject import Ended, Happening, fail, kill, run, send
from torchgrasp.app import cli
from torchgrasp.data.shards import load_shard
from torchgrasp.files import hold_file, hold_folder

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows forks no processes")

REFUSED = re.compile(r"torchgrasp: --(out|checkpoint|parquet): .*(No space left|Read-only).*\n")
"""What is said where the disk refuses."""

OF_A_RUN = re.compile(
    rb"<td>(?:command|date)</td><td>.*?</td>|(?<=points; torchgrasp)[^<]*<br><code>[^<]*</code>"
)
"""What a report says of its own run: the folder and the minute differ."""

HELD = {"sample": "samples", "grasp": "grasps", "evaluate": "evaluation", "campaign": "campaign"}
"""The folder that each command holds."""

STEP = 75
"""Every so many-th call is tried, from another first one in each test."""


def written(folder: Path) -> dict[str, bytes]:
    """Return every file below a folder, by its path there, without what reports say of their run."""
    return {name: OF_A_RUN.sub(b"", data) for name, data in contents(folder).items()}


class Bench(NamedTuple):
    """A command on folders of its own, with what it writes undisturbed and the calls that it makes."""

    command: Command
    whole: dict[str, bytes]
    calls: list[str]
    folder: Path
    step: int

    def disturb(self, first: int, *happenings: Happening) -> Iterator[tuple[Ended, Path]]:
        """Let something happen at many calls, each in a fresh folder; then the command is run again
        to its end.
        """
        for at in range(first % self.step, len(self.calls), self.step):
            out = self.folder / f"{first}-{at}"
            yield run(self.command(out), happenings[at // self.step % len(happenings)], at), out
            again = run(self.command(out))
            assert (again.code, again.said) == (0, ""), (at, self.calls[at], again.said)
            assert written(out) == self.whole, (at, self.calls[at])

    def sound(self, out: Path) -> bool:
        """Tell whether every file under a final name is whole; a checkpoint may be that of another
        step.

        The file of a job is read instead: none is left in the end.
        """
        found = {
            name: data for name, data in written(out).items() if not Path(name).name.startswith(".")
        }
        for name in [name for name in found if "/parts/" in name]:
            load_shard(out / name, {})
            del found[name]
        return all(
            data == self.whole[name] or name.startswith("step") for name, data in found.items()
        )


@pytest.fixture(scope="module", params=COMMANDS)
def bench(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Bench]:
    folder = tmp_path_factory.mktemp(request.param)
    with pytest.MonkeyPatch.context() as patch:
        command = COMMANDS[request.param](patch, folder)
        with contextlib.redirect_stdout(io.StringIO()):
            assert (
                cli.main(command(folder / "first")) == 0
            )  # imports what the children would import each
        ended = run(command(folder / "whole"))
        whole = written(folder / "whole")
        assert (ended.code, ended.said) == (0, "")
        assert {"open", "write", "fsync", "replace", "unlink"} <= set(ended.calls) and len(
            whole
        ) > 1
        assert not any(Path(name).name.startswith(".") for name in whole)
        long = request.config.getoption("--hypothesis-profile") == "long"
        yield Bench(command, whole, ended.calls, folder, 1 if long else STEP)


@pytest.mark.promise("F1")
def test_a_killed_command_is_continued_to_the_same_bytes(bench: Bench):
    for ended, out in bench.disturb(0, kill):
        assert ended.code == -signal.SIGKILL and bench.sound(out)


@pytest.mark.promise("F3")
def test_a_disk_that_refuses_is_named_and_nothing_half_written_stays(bench: Bench):
    for ended, out in bench.disturb(2, fail(errno.ENOSPC), fail(errno.EROFS)):
        assert ended.code in (0, 2) and bench.sound(
            out
        )  # 0: only the removal of a lock was refused
        if ended.code:
            assert REFUSED.fullmatch(ended.said), ended.said
        assert not [name for name in contents(out) if name.endswith(".part")]


@pytest.mark.promise("F6")
def test_a_command_that_is_told_to_end_says_so(bench: Bench):
    for ended, out in bench.disturb(3, send(signal.SIGINT), send(signal.SIGTERM)):
        assert ended[::2] in ((130, "torchgrasp: interrupted\n"), (143, "torchgrasp: terminated\n"))
        assert bench.sound(out)


@pytest.mark.promise("F7")
@pytest.mark.parametrize("name", COMMANDS)
def test_a_second_run_on_what_another_writes_is_refused_by_name(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    command = COMMANDS[name](monkeypatch, tmp_path)
    out = tmp_path / "out"
    with hold_file(out / "model.safetensors") if name == "train" else hold_folder(out / HELD[name]):
        assert cli.main(command(out)) == 2
        said = capsys.readouterr().err
        assert (
            said.startswith("torchgrasp: --out: expected")
            and f"in use by process {os.getpid()} on" in said
        )
        assert not [file for file in contents(out) if not Path(file).name.startswith(".")]
    assert cli.main(command(out)) == 0
