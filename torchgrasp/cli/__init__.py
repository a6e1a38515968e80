"""The command line.

Exit codes: 0 done, 1 no executable grasp or object not held, 2 bad input, 130 interrupted, 143 terminated.
"""

import contextlib
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence

import torch
import tyro

from torchgrasp import __version__
from torchgrasp.cli import clouds, grasps, hands, shapes
from torchgrasp.cli.evaluate import evaluate
from torchgrasp.cli.export import export
from torchgrasp.cli.hand_train import train
from torchgrasp.errors import GraspError

__all__ = ["COMMANDS", "main"]

COMMANDS: dict[str, Callable[..., int]] = {
    "grasp": grasps.grasp,
    "evaluate": evaluate,
    "export": export,
    "objects": grasps.objects,
    "cloud check": clouds.check,
    "cloud cut": clouds.cut,
    "cloud depth": clouds.depth,
    "cloud thin": clouds.thin,
    "cloud render": clouds.render,
    "hand new": hands.new,
    "hand check": hands.check,
    "hand sample": hands.sample,
    "hand train": train,
    "shape surface": shapes.surface,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit code. Errors end as one sentence on stderr."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given == ["--version"]:
        print(f"torchgrasp {__version__}")
        return 0
    # The batches are small: a second thread costs more than it brings, and one gives the same bits on any machine.
    torch.set_num_threads(1)
    try:
        with warnings.catch_warnings(), _end_in_order():
            warnings.showwarning = _show_warning
            return tyro.extras.subcommand_cli_from_dict(
                COMMANDS,
                prog="torchgrasp",
                description="Dexterous fingertip grasps from a partial point cloud.",
                args=_join_group(given),
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except GraspError as error:
        print(f"torchgrasp: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except _Terminated:
        print("torchgrasp: terminated", file=sys.stderr)
        return 143
    except KeyboardInterrupt:
        print("torchgrasp: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of stdout went away; nobody is left to be told
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


class _Terminated(KeyboardInterrupt):
    """SIGTERM, which ends a command as SIGINT does: workers are stopped, and nothing half-written stays."""


@contextlib.contextmanager
def _end_in_order() -> Iterator[None]:
    """Raise `_Terminated` at SIGTERM within the context; only the main thread may say so."""

    def end(*_: object) -> None:
        raise _Terminated

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _show_warning(message: Warning | str, category: type[Warning], *_: object) -> None:
    """Print a warning as one sentence on stderr, like an error."""
    print(f"{category.__name__}: {' '.join(str(message).split())}", file=sys.stderr)


def _join_group(given: list[str]) -> list[str]:
    """Join a group and its command into one word; a group alone asks for help.

    >>> _join_group(["cloud", "check", "a.ply"]), _join_group(["cloud"])
    (['cloud check', 'a.ply'], ['--help'])
    """
    groups = {name.split()[0] for name in COMMANDS if " " in name}
    if given and given[0] in groups and given[1:] in ([], ["--help"], ["-h"]):
        return ["--help"]
    return [" ".join(given[:2]), *given[2:]] if " ".join(given[:2]) in COMMANDS else given
