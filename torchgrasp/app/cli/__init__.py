"""The command line.

Exit codes: 0 done, 1 no executable grasp or object not held, 2 bad input, 130 interrupted, 143 terminated.
"""

import contextlib
import functools
import inspect
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, get_args, get_origin, get_type_hints

import torch
import tyro
from tyro.extras import SubcommandApp

from torchgrasp import __version__
from torchgrasp.checks import check_path
from torchgrasp.app.cli import clouds, grasps, hands, shapes
from torchgrasp.app.cli.campaign import campaign
from torchgrasp.app.cli.doctor import doctor, selftest
from torchgrasp.app.cli.evaluate import evaluate
from torchgrasp.app.cli.export import export, import_grasps
from torchgrasp.app.cli.hand_check import check
from torchgrasp.app.cli.hand_train import train
from torchgrasp.app.cli.results import view
from torchgrasp.errors import GraspError

__all__ = ["COMMANDS", "main", "run_and_exit"]

COMMANDS: dict[str, Callable[..., int]] = {
    "grasp": grasps.grasp,
    "view": view,
    "evaluate": evaluate,
    "campaign": campaign,
    "export": export,
    "import": import_grasps,
    "objects": grasps.objects,
    "doctor": doctor,
    "selftest": selftest,
    "cloud check": clouds.check,
    "cloud cut": clouds.cut,
    "cloud depth": clouds.depth,
    "cloud scene": clouds.scene,
    "cloud thin": clouds.thin,
    "cloud render": clouds.render,
    "cloud views": clouds.views,
    "hand new": hands.new,
    "hand check": check,
    "hand sample": hands.sample,
    "hand train": train,
    "shape surface": shapes.surface,
}
GROUPS = {
    "cloud": "Check, cut, thin and make point clouds.",
    "hand": "Bring a hand of your own: draft, check, sample, train.",
    "shape": "See the shape that was estimated.",
}
"""Groups of commands, by the first word."""


START = """torchgrasp: dexterous fingertip grasps from a partial point cloud

  torchgrasp objects                                  shipped objects: files of a noisy view and of the true mesh
  torchgrasp cloud check CLOUD                        is this cloud ready? what would make it better?
  torchgrasp grasp CLOUD --hand allegro --out DIR     plan grasps of what the cloud shows, with a report

All commands: torchgrasp --help. To read: README.md and docs/ of the repository."""
"""What `torchgrasp` alone prints."""

STDERR = 2
"""The last descriptor of a standard stream (POSIX)."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit code. Errors end as one sentence on stderr.

    >>> main(["--version"])
    torchgrasp ...
    0
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given in ([], ["--version"]):
        print(f"torchgrasp {__version__}" if given else START)
        return 0
    # The batches are small: a second thread costs more than it brings, and one gives the same bits on any machine.
    torch.set_num_threads(1)
    with _open_streams():
        return _run(given)


def run_and_exit() -> NoReturn:
    """Run the command line of this process, and end the process.

    The first SIGINT or SIGTERM ends the command in order. Later ones, of an impatient user, cannot disturb that end.

    >>> import subprocess
    >>> code = "from torchgrasp.app.cli import run_and_exit; run_and_exit()"
    >>> subprocess.run([sys.executable, "-c", code, "--version"], capture_output=True).returncode
    0
    """
    told = False

    def end(sign: int, _: object) -> None:
        nonlocal told
        if not told:
            told = True
            raise _Terminated if sign == signal.SIGTERM else KeyboardInterrupt

    signs = [sign for sign in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(sign) is not signal.SIG_IGN]
    for sign in signs:
        signal.signal(sign, end)
    try:
        code = main()
    finally:
        for sign in signs:
            signal.signal(sign, signal.SIG_IGN)
    sys.exit(code)


def _run(given: list[str]) -> int:
    """Run the command that the words name; return its exit code."""
    try:
        plain = contextlib.redirect_stderr(_WithoutMarkup(sys.stderr))  # pyright: ignore[reportArgumentType]
        with warnings.catch_warnings(), plain:
            warnings.showwarning = _show_warning
            code = _application(COMMANDS).cli(
                prog="torchgrasp",
                description="Dexterous fingertip grasps from a partial point cloud. --version: print the version.",
                args=[*given, "--help"] if given[0] in GROUPS and len(given) == 1 else given,
                config=(tyro.conf.FlagCreatePairsOff,),
            )
            print(end="", flush=True)  # Python's own flush would come too late for an exit code
            return code
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
        _drop_stdout()
        return 1
    except OSError as error:  # whatever reads and writes files raises GraspError: this is a full disk behind stdout
        print(f"torchgrasp: {error}", file=sys.stderr)
        _drop_stdout()
        return 2


@contextlib.contextmanager
def _open_streams() -> Iterator[None]:
    """Lead the streams nowhere that the process was started without, as by a daemon.

    Otherwise the first file that is opened takes their place, and what libraries print goes into it.
    """
    with contextlib.ExitStack() as stack:
        if None in (sys.stdin, sys.stdout, sys.stderr):
            while (free := os.open(os.devnull, os.O_RDWR)) <= STDERR:
                pass
            os.close(free)
        nowhere = stack.enter_context(open(os.devnull, "w")) if None in (sys.stdout, sys.stderr) else None
        if sys.stdout is None:
            stack.enter_context(contextlib.redirect_stdout(nowhere))
        if sys.stderr is None:
            stack.enter_context(contextlib.redirect_stderr(nowhere))
        yield


def _drop_stdout() -> None:
    """Lead stdout nowhere: Python would try to write the rest at its end."""
    with contextlib.suppress(OSError, ValueError, AttributeError):  # it may be closed, or no file
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # pyright: ignore[reportOptionalMemberAccess]


class _WithoutMarkup:
    """A stream without tyro's markup, which its message on too few numbers of an option shows as it is."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        """Write the text; the frame around it stays in line."""
        room = " " * len("[bold][/bold]")
        return self.stream.write(
            re.sub(r"\[bold\](.*?)\[/bold\](.*?)( │?)$", rf"\1\2{room}\3", text, flags=re.MULTILINE)
        )

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


class _Terminated(KeyboardInterrupt):
    """SIGTERM, which ends a command as SIGINT does: workers are stopped, and nothing half-written stays."""


def _show_warning(message: Warning | str, category: type[Warning], *_: object) -> None:
    """Print a warning as one sentence on stderr, like an error."""
    print(f"{category.__name__}: {' '.join(str(message).split())}", file=sys.stderr)


def _application(commands: dict[str, Callable[..., int]]) -> SubcommandApp:
    """Return the parser of commands; those of two words are grouped by the first."""
    top, groups = SubcommandApp(), dict[str, SubcommandApp]()
    for name, function in commands.items():
        group, _, last = name.rpartition(" ")
        if group and group not in groups:
            groups[group] = SubcommandApp()
            top.command(groups[group], name=group, help=GROUPS[group])
        (groups[group] if group else top).command(name=last)(_naming_paths(function))
    return top


def _naming_paths(function: Callable[..., int]) -> Callable[..., int]:
    """Return a command that refuses by its option what is no path."""
    signature, hints = inspect.signature(function), get_type_hints(function, include_extras=True)

    @functools.wraps(function)
    def command(*args: Any, **named: Any) -> int:
        for name, value in signature.bind(*args, **named).arguments.items():
            if isinstance(value, Path):
                positional = tyro.conf.Positional in getattr(hints[name], "__metadata__", ())
                check_path(name.upper() if positional else f"--{name.replace('_', '-')}", value)
        return function(*args, **named)

    # The parser prints the text of an argument as it stands, and looks behind wrappers for it: lines are joined here.
    command.__doc__ = re.sub(r"\n {8,}", " ", inspect.cleandoc(function.__doc__ or ""))
    command.__signature__ = signature  # pyright: ignore[reportAttributeAccessIssue]
    command.__annotations__ = {name: _shown(hint, signature.parameters.get(name)) for name, hint in hints.items()}
    del command.__wrapped__
    return command


def _shown(hint: Any, parameter: inspect.Parameter | None) -> Any:
    """Return the annotation of an option; the help is silent of a default that says nothing: None, False and ()."""
    quiet = parameter is not None and any(parameter.default is empty for empty in (None, False, ()))
    if not quiet or get_origin(hint) is Annotated:
        return hint
    kinds = [kind for kind in get_args(hint) if kind is not type(None)]
    metavar = _metavar(kinds[0]) if type(None) in get_args(hint) and len(kinds) == 1 else None
    return Annotated[hint, tyro.conf.arg(metavar=metavar, help_behavior_hint="")]


def _metavar(kind: Any) -> str:
    """Return what stands for a value in the help.

    >>> _metavar(tuple[float, float]), _metavar(tuple[float, ...]), _metavar(Literal["a", "b"])
    ('FLOAT FLOAT', 'FLOAT [FLOAT ...]', '{a,b}')
    """
    parts = get_args(kind)
    if get_origin(kind) is Literal:
        return f"{{{','.join(map(str, parts))}}}"
    if get_origin(kind) is tuple:
        return f"{_metavar(parts[0])} [{_metavar(parts[0])} ...]" if ... in parts else " ".join(map(_metavar, parts))
    return "PATH" if kind is Path else kind.__name__.upper()
