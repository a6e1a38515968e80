"""Atomic writing of files (written under another name, then moved into place), and locks on folders
and files.
"""

import contextlib
import dataclasses
import functools
import hashlib
import io
import json
import math
import os
import socket
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from filelock import FileLock, Timeout

from torchgrasp.foundation.errors import BadArgument, OutputError, Status
from torchgrasp.foundation.lazy import jinja2

Refuse = Callable[[str, str], BadArgument]  # makes an error of what was found and what is allowed
# ending of the name under which a file is written; a dot and the name of the file come first
ENDING = ".part"
READABLE = 0o644  # permissions of a written file: all may read it
HOLDER_LETTERS = 200  # letters of a lock file that an error shows
LOCK = ".lock"  # name of the lock file in a folder. It holds the process and host of the run.


def write_file(path: Path | str, content: str | bytes | Callable[[IO[bytes]], object]) -> Path:
    """Write a file atomically, so that it is complete or unchanged, and return its path.

    `content` is text (written as UTF-8), bytes, or a function that writes bytes to the file object
    that it is given. A missing folder is created. Raises `OutputError` if the folder cannot be
    written, or the disk is full.
    """
    path = Path(path)
    data = content.encode() if isinstance(content, str) else content
    if not isinstance(data, bytes):
        buffer = io.BytesIO()
        data(buffer)
        data = buffer.getvalue()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, part = tempfile.mkstemp(prefix=f".{path.name}.", suffix=ENDING, dir=path.parent)
        try:
            with os.fdopen(handle, "wb", buffering=0) as file:
                left = memoryview(data)
                while len(left):
                    left = left[os.write(file.fileno(), left) :]
                os.fsync(file.fileno())  # or a power cut could leave the name without the content
            os.chmod(part, READABLE)
            os.replace(part, path)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(part)
            raise
    except OSError as error:
        raise OutputError(
            "path", f"{path} ({error.strerror or error})", "a file in a writable folder"
        ) from error
    return path


def remove_file(path: Path) -> None:
    """Remove a file, if it is there; raise `OutputError` if it cannot be removed."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(
            "path", f"{path} ({error.strerror or error})", "a file that can be removed"
        ) from error


class Malformed(ValueError):
    """Raised for malformed content of a file.

    Its message is written by this library for the user; `explain` passes it on unchanged.
    """


def explain(error: Exception) -> str:
    """Return a sentence that says what is wrong with a file that could not be parsed; `error` is
    the parser's error.

    For a `Malformed` it is the error's own text. For errors of other libraries it is a general
    sentence.
    """
    return str(error) if isinstance(error, Malformed) else "a content that is broken or cut off"


def is_file(path: Path | str) -> bool:
    """Return whether a path is a regular file. False also if it is no path at all, such as None, or
    too long for the system.
    """
    try:
        return Path(path).is_file()
    except (OSError, TypeError, ValueError):
        return False


def read_bytes(path: Path | str) -> bytes:
    """Return the content of a file. No more bytes are read than the size that the system reports,
    because some system files never end.
    """
    with Path(path).open("rb") as file:
        return file.read(os.fstat(file.fileno()).st_size)


def read_bounded(path: Path | str, most: int, allowed: str, refuse: Refuse) -> bytes:
    """Return the content of a regular file of at most `most` bytes.

    The error `refuse(found, allowed)` is raised for a larger file, a missing one, a folder or
    device, or a pointer of Git LFS. `allowed` says what is expected.
    """
    check_file(path, most, allowed, refuse)
    try:
        data = read_bytes(path)
    except OSError as error:
        raise refuse(f"{path}: {error}", allowed) from error
    if data.startswith(b"version https://git-lfs."):
        raise refuse(f"{path}, a pointer of Git LFS", f"{allowed}: git lfs pull")
    return data


def check_file(path: Path | str, most: int, allowed: str, refuse: Refuse) -> None:
    """Raise an error unless a path is a regular file of at most `most` bytes.

    The error is `refuse(found, allowed)`; `allowed` says what is expected.
    """
    if not is_file(path):
        raise refuse(f"{path}, which is no file", allowed)
    if (size := Path(path).stat().st_size) > most:
        raise refuse(f"{path} of {size} bytes", f"{allowed} of at most {most} bytes")


def sha256(path: Path | str) -> str:
    """Return the SHA-256 of a file in hexadecimal digits."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def format_json(value: Any) -> str:
    """Return a value as JSON text; a member of the enum `Status` is written as its name, NaN and
    infinity as null.
    """
    return json.dumps(plain_value(value), indent=1)


def plain_value(value: Any, digits: int | None = None) -> Any:
    """Return a value fit for JSON: a status becomes its name, a dataclass a dict, and NaN and
    infinity become None. Numbers are rounded to `digits` decimals; None does not round them.
    """
    if dataclasses.is_dataclass(value):
        return plain_value(vars(value), digits)
    if isinstance(value, dict):
        return {key: plain_value(x, digits) for key, x in value.items()}
    if isinstance(value, list | tuple):
        return [plain_value(x, digits) for x in value]
    if isinstance(value, Status):
        return value.name
    if not isinstance(value, float):
        return value
    if not math.isfinite(value):
        return None
    return value if digits is None else round(value, digits)


def render(
    template: Path, filters: Mapping[str, Callable[..., object]] | None = None, **values: Any
) -> str:
    """Return the text of a Jinja template whose variables have the given `values`.

    `template` is the path of the template's file. `filters` are further filters of Jinja by name;
    None means none. Texts that are put into HTML or XML are escaped.
    """
    engine = template_engine(template.parent)
    engine.filters |= filters or {}
    return engine.get_template(template.name).render(values)


@functools.cache
def template_engine(folder: Path) -> "jinja2.Environment":
    """Return the Jinja environment that loads templates from a folder, the same one at each call.

    It escapes values in templates whose names end in .html, .js, .css or .xml.jinja.
    """
    loader = jinja2.FileSystemLoader(folder)
    escape = jinja2.select_autoescape(("html", "js", "css", "xml.jinja"))
    return jinja2.Environment(
        loader=loader,
        autoescape=escape,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def format_columns(rows: Sequence[Sequence[str]], left: Collection[int] = ()) -> str:
    """Return a table of text cells as lines of aligned columns, one line for each of the `rows`.

    Columns are right-aligned; those with an index in `left` are left-aligned.
    """
    longest = [max(map(len, column)) for column in zip(*rows, strict=True)]
    widths = [-width if k in left else width for k, width in enumerate(longest)]
    return "\n".join(format_line(row, widths) for row in rows)


def format_line(cells: Sequence[object], widths: Sequence[int]) -> str:
    """Return cells as one line of text, each as wide as `widths` says in characters.

    A cell of negative width is left-aligned, one of positive width right-aligned. Two blanks
    separate the cells.
    """
    columns = zip(cells, widths, strict=True)
    return "  ".join(f"{cell!s:{'<' if w < 0 else '>'}{abs(w)}}" for cell, w in columns).rstrip()


@contextlib.contextmanager
def hold_folder(folder: Path) -> Iterator[None]:
    """Create a folder, lock it until the context ends, and remove half-written files in it.

    A folder that was created here is removed again if it is empty at the end. Raises `OutputError`
    for a folder that another run has locked, or that cannot be written.
    """
    with _hold("folder", folder, folder / LOCK):
        _remove_parts(folder.rglob(f".*{ENDING}"))
        yield


@contextlib.contextmanager
def hold_file(path: Path) -> Iterator[None]:
    """Lock a file until the context ends, by a lock file beside it. The file need not exist.

    Half-written copies of the file, which an interrupted run left, are removed. Raises
    `OutputError` for a file that another run has locked, or that cannot be written.
    """
    with _hold("path", path, path.with_name(f".{path.name}{LOCK}")):
        _remove_parts(
            x for x in path.parent.glob(f".*{ENDING}") if x.name.startswith(f".{path.name}.")
        )
        yield


def begin_folder(path: Path, content: str, what: str) -> None:
    """Write the text `content` to the file `path`, to record what the folder of this file is for.

    Nothing is written if the file has this content already. Raises `OutputError` if the file has
    another content, or if its folder holds other files but not this one. `what` is a word for the
    folder's content in errors, such as "campaigns".
    """
    check_begun(path)
    if not path.exists():
        write_file(path, content)
    elif path.read_text("utf-8", errors="replace") != content:
        raise OutputError(
            "folder",
            f"{path.parent}, which holds other {what}",
            f"an empty folder, or the same {what}",
        )


def check_begun(path: Path) -> None:
    """Raise `OutputError` if the folder of the file `path` holds other files, but not this one.

    Its lock file (.lock) and half-written files do not count.
    """
    folder = path.parent
    if not path.exists() and {*folder.glob("*")} - {folder / LOCK, *folder.glob(f".*{ENDING}")}:
        raise OutputError("folder", f"{folder}, which holds other files", "an empty folder")


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """Yield a temporary folder; it is removed at the end of the context."""
    with tempfile.TemporaryDirectory(prefix="torchgrasp-", ignore_cleanup_errors=True) as folder:
        yield Path(folder)


@contextlib.contextmanager
def _hold(argument: str, what: Path, path: Path) -> Iterator[None]:
    """Lock a folder or a file within the context, by a lock file at `path`."""
    folder = path.parent
    kind = "folder" if argument == "folder" else "file"
    made = [x for x in (folder, *folder.parents) if not x.exists()]
    lock = FileLock(path, timeout=0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except Timeout as error:
        allowed = f"a {kind} that no other run writes"
        raise OutputError(argument, f"{what}, in use by {_holder(path)}", allowed) from error
    except OSError as error:
        place = "folder" if argument == "folder" else "file in a folder"
        allowed = f"a {place} that can be written"
        raise OutputError(argument, f"{what} ({error.strerror or error})", allowed) from error
    try:
        with contextlib.suppress(OSError):  # on some systems nobody can write a locked file
            path.write_text(f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8")
        yield
    finally:
        # Before the release: another run might lock the file before it is removed.
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
        lock.release()
        with contextlib.suppress(OSError):
            if os.name == "nt":  # Windows removes no locked file
                path.unlink(missing_ok=True)
            for empty in made:
                empty.rmdir()


def _holder(path: Path) -> str:
    """Return the process and host of the run that holds a lock, as its lock file states them."""
    try:
        return path.read_text(encoding="utf-8")[:HOLDER_LETTERS].strip() or "another run"
    except (OSError, UnicodeDecodeError):
        return "another run"


def _remove_parts(paths: Iterator[Path]) -> None:
    """Remove the half-written files of an interrupted run; the folder's lock ensures that no other
    run is writing.
    """
    for part in list(paths):
        with contextlib.suppress(OSError):
            part.unlink()
