"""Commands as frozen dataclasses: a field is a command-line argument with default and help; `run`
does the work.
"""

import contextlib
import contextvars
import dataclasses
import logging
import os
import shlex
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TextIO, TypeVar, get_args, get_origin

import tyro
from tqdm import tqdm

from torchgrasp.files import format_json
from torchgrasp.foundation import fused
from torchgrasp.foundation.checks import check_value
from torchgrasp.foundation.errors import BadArgument

T = TypeVar("T")
BEAT = 15.0
"""Seconds between the lines that tell how far a command is, where stderr is no terminal."""
WORDS: contextvars.ContextVar[tuple[str, ...]] = contextvars.ContextVar("WORDS", default=())
"""The words of the command line that runs."""
ANSWER: contextvars.ContextVar[TextIO | None] = contextvars.ContextVar("ANSWER", default=None)
"""Where --json writes; None without --json."""
QUIET: contextvars.ContextVar[bool] = contextvars.ContextVar("QUIET", default=False)
"""Whether only results, warnings and errors are told."""


class Command:
    """Base of all commands.

    `names` maps an argument of the library to the field of the command that gives it, such as
    {"points": "cloud"}. An error that names the argument is shown with this field's option.
    """

    names: ClassVar[dict[str, str]] = {}

    def run(self) -> int:
        """Run the command; return the exit code."""
        raise NotImplementedError


def option(default: Any, help: str) -> Any:
    """Return a dataclass field that is a command-line option, `--its-name`, with a default.

    `help` is its help text.
    """
    return dataclasses.field(default=default, metadata={"help": help})


def required(help: str) -> Any:
    """Return a dataclass field that is a required command-line option with a `help` text."""
    return dataclasses.field(metadata={"help": help})


def positional(help: str, default: Any = dataclasses.MISSING) -> Any:
    """Return a dataclass field that is a positional command-line argument with a `help` text.

    It is required unless it has a `default`, such as None.
    """
    return dataclasses.field(default=default, metadata={"help": help, "positional": True})


def nested(default: Any) -> Any:
    """Return a dataclass field whose own fields are options of the command.

    `default` is a value of a class decorated by `arguments`.
    """
    return dataclasses.field(default=default, metadata={"nested": True})


def arguments(**names: str) -> Callable[[type[T]], type[T]]:
    """Return a decorator that makes a class a frozen dataclass of command-line arguments.

    Each keyword of `names` is an argument of the library, and its value a field of the class. With
    `points="cloud"`, an error about the library's argument `points` names the user's option of the
    field `cloud`.
    """

    def make(cls: type[T]) -> type[T]:
        made: Any = dataclasses.dataclass(frozen=True, kw_only=True)(cls)
        made.__annotations__ = {f.name: _annotate(f) for f in dataclasses.fields(made)}
        made.names = getattr(cls, "names", {}) | names
        return made

    return make


def _annotate(field: dataclasses.Field) -> Any:
    """Return the annotation of a field with its help text; the defaults None, False and () are not
    shown.
    """
    if field.metadata.get("nested"):
        # without a text, tyro would read the source of the command for one
        return Annotated[field.type, tyro.conf.arg(name="", help="")]
    text = field.metadata["help"]
    if field.metadata.get("positional"):
        hint = "" if field.default is None else None
        named = tyro.conf.arg(help=text, metavar=field.name.upper(), help_behavior_hint=hint)
        return Annotated[tyro.conf.Positional[field.type], named]
    if not any(field.default is empty for empty in (None, False, ())):
        return Annotated[field.type, tyro.conf.arg(help=text)]
    kinds = [kind for kind in get_args(field.type) if kind is not type(None)]
    metavar = _metavar(kinds[0]) if type(None) in get_args(field.type) and len(kinds) == 1 else None
    return Annotated[field.type, tyro.conf.arg(help=text, metavar=metavar, help_behavior_hint="")]


def _metavar(kind: Any) -> str:
    """Return the placeholder of a value in the help text, such as "FLOAT FLOAT" or "{a,b}"."""
    parts = get_args(kind)
    if get_origin(kind) is Annotated:
        return _metavar(parts[0])
    if get_origin(kind) is Literal:
        return f"{{{','.join(map(str, parts))}}}"
    if get_origin(kind) is tuple:
        return (
            f"{_metavar(parts[0])} [{_metavar(parts[0])} ...]"
            if ... in parts
            else " ".join(map(_metavar, parts))
        )
    return "PATH" if kind is Path else kind.__name__.upper()


def execute(command: Command) -> int:
    """Check a command's arguments by their annotations, then run it; return the exit code.

    Errors name the command-line options. Raises `BadArgument` for a number out of its range, an
    invalid path, or an --out that is a file which the command reads.
    """
    fields = {f.name: f for f in dataclasses.fields(command) if "help" in f.metadata}  # pyright: ignore[reportArgumentType]
    options = {
        name: name.upper() if field.metadata.get("positional") else f"--{name.replace('_', '-')}"
        for name, field in fields.items()
    }
    names = options | {argument: options[name] for argument, name in command.names.items()}
    with naming(**names), _speaking(command):
        for name, field in fields.items():
            check_value(name, getattr(command, name), field.type)
        out = getattr(command, "out", None)
        if isinstance(out, Path):
            read = (value for name, value in vars(command).items() if name != "out")
            check_kept(out, *read)
        return command.run()


def check_kept(out: Path, *read: Any) -> None:
    """Raise `BadArgument`, which names --out, if the file `out` is one of those that are read.

    Among the values `read`, paths count, also in tuples and in dataclasses of options.
    """
    for value in read:
        if isinstance(value, tuple):
            check_kept(out, *value)
        elif dataclasses.is_dataclass(value):
            check_kept(out, *vars(value).values())
        elif isinstance(value, Path) and out.is_file() and value.is_file() and out.samefile(value):
            raise BadArgument("--out", f"{out}, which is read", "another file: it would be lost")


@arguments()
class ForPrograms(Command):
    """Options of commands that programs call: what is printed, and where."""

    json: bool = option(False, "print the result as JSON on stdout, and all words on stderr")
    quiet: bool = option(False, "print no words: only warnings, errors and the JSON of --json")


def answer(content: Any) -> None:
    """Print the result of a command as JSON on stdout, if it runs with --json.

    NaN and infinity become null.
    """
    stream = ANSWER.get()
    if stream is not None:
        print(format_json(content).rstrip("\n"), file=stream, flush=True)


def command_line() -> str:
    """Return the command line that runs, as it would be typed; "" outside a command."""
    words = WORDS.get()
    return shlex.join(["torchgrasp", *words]) if words else ""


@contextlib.contextmanager
def _speaking(command: Command) -> Iterator[None]:
    """Within the context, words go where --json and --quiet send them."""
    json: bool = getattr(command, "json", False)
    quiet: bool = getattr(command, "quiet", False)
    if not isinstance(command, ForPrograms) or not (json or quiet):
        yield
        return
    with contextlib.ExitStack() as stack:
        before = ANSWER.set(sys.stdout if json else None)
        stack.callback(ANSWER.reset, before)
        stack.callback(QUIET.reset, QUIET.set(quiet))
        words = sys.stderr
        if quiet:
            words = stack.enter_context(open(os.devnull, "w"))
            # that loops are compiled is no warning
            loops = logging.getLogger(fused.__name__)
            stack.callback(loops.setLevel, loops.level)
            loops.setLevel(logging.ERROR)
        stack.enter_context(contextlib.redirect_stdout(words))
        yield


@contextlib.contextmanager
def naming(**options: str) -> Iterator[None]:
    """Within the context, replace the name of the argument in a `BadArgument` by the name of its
    command-line option.

    `options` gives the option of each argument by name, as `points="--cloud"`.
    """
    try:
        yield
    except BadArgument as error:
        argument = error.argument.split("[")[0]  # an item of a list has its place in brackets
        if argument not in options:
            raise
        raise type(error)(options[argument], error.found, error.allowed) from error


class StageProgress:
    """Progress output of a command: a line for each finished stage, and a bar on a terminal.

    The bar names the stage that is running.

    Args:
        names: names of the stages in order.

    Attributes:
        stages: name, message and wall time [s] of each finished stage.
        values: results of the finished stages by name.
    """

    def __init__(self, *names: str) -> None:
        self.next = dict(zip(names, (*names[1:], "done"), strict=True))
        self.place = {name: k + 1 for k, name in enumerate(names)}
        self.stages: list[tuple[str, str, float]] = []
        self.values: dict[str, Any] = {}
        self.began = time.perf_counter()
        self.bar = make_bar(len(names), "stage", desc=names[0], delay=1)

    def end(self, name: str, message: str, value: Any = None) -> None:
        """Print the `message` of the stage `name`, which has ended, with its wall time [s].

        Its result `value` is kept in `values`; the bar then shows the next stage.
        """
        now = time.perf_counter()
        self.stages.append((name, message, now - self.began))
        self.values[name] = value
        with self.bar.external_write_mode(sys.stdout):
            print(f"{name:8}{now - self.began:6.1f} s  {message}", flush=True)
        self.began = now
        if name in self.next:
            # a stage that runs again, as in a later batch, is no step forward
            self.bar.update(max(self.place[name] - self.bar.done, 0))
            self.bar.set_description(self.next[name])


def make_bar(total: int | None, unit: str, **options: Any) -> "_Beating":
    """Return a tqdm progress bar; where stderr is no terminal, it prints lines instead.

    `total` is the number of steps, None if it is unknown; `unit` is the name of a step. `options`
    are further arguments of tqdm. The lines say every 15 s (`BEAT`) how many steps are done. With
    --quiet there are none.
    """
    return _Beating(total=total, unit=unit, disable=None, leave=False, **options)


class _Beating(tqdm):
    """A progress bar that prints a line from time to time where there is no terminal."""

    def __init__(self, *, unit: str, desc: str = "", **options: Any) -> None:
        super().__init__(unit=unit, desc=desc, **options)
        self.named = unit
        self.done = 0
        self.began = time.monotonic()
        self.ended: threading.Event | None = None
        if self.disable:
            self.desc = desc  # tqdm keeps none for a bar that it does not draw
            self.ended = None if QUIET.get() else threading.Event()

    def update(self, n: int | float | None = 1) -> bool | None:
        """Count `n` more steps as done."""
        self.done += int(n or 0)
        return super().update(n)

    def describe(self) -> str:
        """Return how many steps are done, and the seconds since the start."""
        label = f"{self.desc.rstrip(': ')}: " if self.desc else ""
        of = f" of {self.total}" if self.total else ""
        seconds = time.monotonic() - self.began
        return f"{label}{self.done}{of} {self.named}s, {seconds:.0f} s"

    def __enter__(self) -> "_Beating":
        """Begin to print lines, if the bar is not drawn."""
        if self.ended is not None:
            threading.Thread(target=self._beat, args=(self.ended,), daemon=True).start()
        return self

    def close(self) -> None:
        """End the bar and its lines."""
        if self.ended is not None:
            self.ended.set()
        super().close()

    def _beat(self, ended: threading.Event) -> None:
        while not ended.wait(BEAT):
            print(self.describe(), file=sys.stderr, flush=True)
