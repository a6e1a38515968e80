"""The command line `torchgrasp`.

Exit codes: 0 done, 1 no executable grasp or object not held, 2 bad input, 130 interrupted, 143
terminated.
"""

import contextlib
import gc
import importlib
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NoReturn

import torch
import tyro
from tyro.extras import SubcommandApp

from torchgrasp import __version__
from torchgrasp.app.cli.command import WORDS, Command, execute
from torchgrasp.foundation.errors import BadArgument, GraspError, one_line

__all__ = ["main", "run_and_exit"]

TERMINATED = 143
INTERRUPTED = 130
"""Exit codes of a command that a signal ended: 128 and the number of SIGTERM or SIGINT."""
CHAPTERS = {
    "Plan grasps": {
        "grasp": "grasp.Grasp",
        "view": "look.OpenPage",
        "film": "filming.Film",
        "objects": "look.ListObjects",
    },
    "Exchange grasps with other programs": {
        "export": "export.Export",
        "import": "importing.Import",
        "mcp": "agents.ServeAgents",
    },
    "Try many grasps in simulation": {
        "evaluate": "evaluate.Evaluate",
        "campaign": "evaluate.RunCampaign",
    },
    "Point clouds and shapes": {
        "cloud check": "clouds.CloudCheck",
        "cloud cut": "clouds.CloudCut",
        "cloud depth": "depth_images.CloudDepth",
        "cloud scene": "depth_images.CloudScene",
        "cloud thin": "clouds.CloudThin",
        "cloud render": "clouds.CloudRender",
        "cloud views": "clouds.CloudViews",
        "shape surface": "clouds.ShapeSurface",
    },
    "Hands": {
        "hand new": "hands.HandNew",
        "hand check": "hands.HandCheck",
        "hand sample": "hands.HandSample",
        "hand train": "hands.HandTrain",
    },
    "Installation": {"doctor": "doctor.Doctor", "selftest": "doctor.Selftest"},
}
"""Modules and classes of the commands by name, in the chapters of the help."""
Callables = Callable[..., Command | int]
COMMANDS: dict[str, str | Callables] = {
    name: place for commands in CHAPTERS.values() for name, place in commands.items()
}
"""The places of the commands, or functions, by name; only the module of a used one is imported."""
GROUPS = {
    "cloud": "Check, cut, thin and make point clouds.",
    "shape": "Write the estimated shape.",
    "hand": "Add a hand: draft, check, sample, train.",
}
"""Groups of commands, by the first word."""

START = """torchgrasp: dexterous fingertip grasps from a partial point cloud

  torchgrasp grasp jug              plan grasps of a shipped object, with a report in out/jug
  torchgrasp view out/jug           turn the result in the browser
  torchgrasp cloud check CLOUD      check your own cloud, with advice for a better one
  torchgrasp grasp CLOUD --hand allegro --out DIR

All commands: torchgrasp --help. To read: README.md and docs/ of the repository."""
"""The text that `torchgrasp` prints when it is called without arguments."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line in this process; return its exit code.

    The code is 0 for success and 2 for bad input. It is 1 for a bad result, such as no grasp that
    passed all checks. An interrupted run gives 130. Errors are printed as one sentence on stderr.

    PyTorch uses one thread from then on. Raises `SystemExit` after the help of a command, and for
    unknown options.

    Args:
        arguments: the words after `torchgrasp`; None means those of this process.

    >>> main(["--version"])
    torchgrasp ...
    0
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    # The batches are small: a second thread costs more than it gains. One thread gives the same
    # bits on any machine.
    torch.set_num_threads(1)
    before = WORDS.set(tuple(given))
    try:
        with _open_streams():
            return _guard(given)
    finally:
        WORDS.reset(before)


def run_and_exit() -> NoReturn:
    """Run the command line with the arguments of this process, and end the process with its exit
    code.

    The first SIGINT or SIGTERM ends the command cleanly. Later signals are ignored, so that the
    command can clean up.

    >>> import subprocess
    >>> code = "from torchgrasp.app.cli import run_and_exit; run_and_exit()"
    >>> subprocess.run([sys.executable, "-c", code, "--version"], capture_output=True).returncode
    0
    """
    ending = False

    def end(sign: int, _: object) -> None:
        nonlocal ending
        if not ending:
            ending = True
            raise _Terminated if sign == signal.SIGTERM else KeyboardInterrupt

    signs = [
        sign
        for sign in (signal.SIGINT, signal.SIGTERM)
        if signal.getsignal(sign) is not signal.SIG_IGN
    ]
    for sign in signs:
        signal.signal(sign, end)
    # what is imported stays: the collector need not look at it again
    gc.freeze()
    try:
        code = main()
    finally:
        for sign in signs:
            signal.signal(sign, signal.SIG_IGN)
    sys.exit(code)


def _guard(given: list[str]) -> int:
    """Run a command, print each error as one sentence on stderr, and return the exit code."""
    try:
        code = _run(given)
        print(end="", flush=True)  # Python's own flush would come too late for an exit code
        return code
    except GraspError as error:
        print(f"torchgrasp: {one_line(error)}", file=sys.stderr)
        return 2
    except _Terminated:
        print("torchgrasp: terminated", file=sys.stderr)
        return TERMINATED
    except KeyboardInterrupt:
        print("torchgrasp: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of stdout is gone, so nobody reads a message
        _drop_stdout()
        return 1
    # readers and writers of files raise GraspError: this is a full disk behind stdout
    except OSError as error:
        print(f"torchgrasp: {error}", file=sys.stderr)
        _drop_stdout()
        return 2


def _run(given: list[str]) -> int:
    """Run the command that the arguments name; return its exit code."""
    if given in ([], ["--version"], ["--help"], ["-h"]):
        if not given:
            print(START)
        else:
            print(f"torchgrasp {__version__}" if given == ["--version"] else format_help())
        return 0
    names = {name.split()[0] for name in COMMANDS}
    if given[0] not in names and not given[0].startswith("-"):
        raise BadArgument("COMMAND", f"{given[0]!r}", f"one of {', '.join(sorted(names))}")
    plain = contextlib.redirect_stderr(_WithoutMarkup(sys.stderr))  # pyright: ignore[reportArgumentType]
    with warnings.catch_warnings(), plain:
        warnings.showwarning = _show_warning
        command = _parser(given[0]).cli(
            prog="torchgrasp",
            description="Dexterous fingertip grasps from a partial point cloud.",
            args=[*given, "--help"] if given[0] in GROUPS and len(given) == 1 else given,
            config=(tyro.conf.FlagCreatePairsOff,),
        )
        return execute(command) if isinstance(command, Command) else command


def _load(command: str | Callables) -> Callables:
    """Return a command, given its place or itself."""
    if not isinstance(command, str):
        return command
    module, _, name = command.partition(".")
    return getattr(importlib.import_module(f"{__name__}.{module}"), name)


def _parser(first: str) -> SubcommandApp:
    """Return the argument parser of the commands that begin with the word `first`, or of all if
    none does. Commands of two words are grouped by the first word.
    """
    wanted = [name for name in COMMANDS if name.split()[0] == first]
    top = SubcommandApp()
    groups = dict[str, SubcommandApp]()
    for name in wanted or COMMANDS:
        group, _, last = name.rpartition(" ")
        if group and group not in groups:
            groups[group] = SubcommandApp()
            top.command(groups[group], name=group, help=GROUPS[group])
        (groups[group] if group else top).command(name=last)(_load(COMMANDS[name]))
    return top


def format_help() -> str:
    """Return the help text of `torchgrasp`: all commands in chapters, each with its summary."""
    lines = ["torchgrasp: dexterous fingertip grasps from a partial point cloud", ""]
    for chapter, commands in CHAPTERS.items():
        lines.append(chapter)
        for name, command in commands.items():
            first = (_load(command).__doc__ or "").split("\n\n")[0].split()
            lines.append(f"  {name:15}{' '.join(first)}")
        lines.append("")
    lines.append("Options of a command: torchgrasp COMMAND --help. Version: torchgrasp --version.")
    return "\n".join(lines)


@contextlib.contextmanager
def _open_streams() -> Iterator[None]:
    """Replace missing standard streams by the null device, so that no other file gets their
    descriptors.
    """
    with contextlib.ExitStack() as stack:
        if None in (sys.stdin, sys.stdout, sys.stderr):
            # 0 to 2 are the descriptors of the standard streams
            while (free := os.open(os.devnull, os.O_RDWR)) <= 2:
                pass
            os.close(free)
        nowhere = None
        if None in (sys.stdout, sys.stderr):
            nowhere = stack.enter_context(open(os.devnull, "w"))
        if sys.stdout is None:
            stack.enter_context(contextlib.redirect_stdout(nowhere))
        if sys.stderr is None:
            stack.enter_context(contextlib.redirect_stderr(nowhere))
        yield


def _drop_stdout() -> None:
    """Redirect stdout to the null device, because Python would try to flush it at the end."""
    # stdout may be closed, or no file
    with contextlib.suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # pyright: ignore[reportOptionalMemberAccess]


class _WithoutMarkup:
    """An output stream that removes markup such as [bold] from the text, where tyro would print it
    literally.
    """

    def __init__(self, stream: Any) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        """Write the text with its markup removed. If the text is framed, the right border stays
        aligned.
        """
        plain = rf"\1\2{' ' * len('[bold][/bold]')}\3"
        return self.stream.write(
            re.sub(r"\[bold\](.*?)\[/bold\](.*?)( │?)$", plain, text, flags=re.MULTILINE)
        )

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


class _Terminated(KeyboardInterrupt):
    """Raised on SIGTERM, which ends a command like SIGINT: workers stop, and no half-written file
    is left.
    """


def _show_warning(message: Warning | str, category: type[Warning], *_: object) -> None:
    """Print a warning as one sentence on stderr, like an error."""
    print(f"{category.__name__}: {one_line(message)}", file=sys.stderr)
