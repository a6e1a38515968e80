"""Atomic writing of files (written under another name, then moved into place), and locks on folders
and files.
"""

import contextlib
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
    """Write text (as UTF-8), bytes, or what a function writes to a file object, atomically; return
    the path.

    A missing folder is created. `OutputError` is raised if the folder cannot be written, or the
    disk is full.
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
    """What is wrong with a file's content, as a sentence of ours."""


def explain(error: Exception) -> str:
    """Return what is wrong with a file that a parser failed on; sentences of other libraries are
    left out.
    """
    return str(error) if isinstance(error, Malformed) else "a content that is broken or cut off"


def is_file(path: Path | str) -> bool:
    """Return whether a path is a regular file; False for a path of a wrong type or length."""
    try:
        return Path(path).is_file()
    except (OSError, TypeError, ValueError):
        return False


def read_bytes(path: Path | str) -> bytes:
    """Return the content of a file, cut at its reported size, because some system files never end."""
    with Path(path).open("rb") as file:
        return file.read(os.fstat(file.fileno()).st_size)


def read_bounded(path: Path | str, most: int, allowed: str, refuse: Refuse) -> bytes:
    """Return the content of a regular file of at most `most` bytes; raise the error of `refuse` for
    other files.
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
    """Raise the error of `refuse` unless a path is a regular file of at most `most` bytes."""
    if not is_file(path):
        raise refuse(f"{path}, which is no file", allowed)
    if (size := Path(path).stat().st_size) > most:
        raise refuse(f"{path} of {size} bytes", f"{allowed} of at most {most} bytes")


def sha256(path: Path | str) -> str:
    """Return the SHA-256 of a file in hexadecimal digits."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def format_json(value: Any) -> str:
    """Return a value as JSON text; a status becomes its name, NaN and infinity become null."""
    return json.dumps(_plain(value), indent=1)


def _plain(value: Any) -> Any:
    """Return a value fit for JSON: a status becomes its name, and NaN and infinity become None."""
    if isinstance(value, dict):
        return {key: _plain(x) for key, x in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(x) for x in value]
    if isinstance(value, Status):
        return value.name
    return None if isinstance(value, float) and not math.isfinite(value) else value


def render(
    template: Path, filters: Mapping[str, Callable[..., object]] | None = None, **values: Any
) -> str:
    """Return a text from a template of Jinja and values; texts that are put into HTML or XML are
    escaped.
    """
    engine = template_engine(template.parent)
    engine.filters |= filters or {}
    return engine.get_template(template.name).render(values)


@functools.cache
def template_engine(folder: Path) -> "jinja2.Environment":
    """Return the template engine of a folder."""
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
    """Return rows of cells as aligned lines of text; columns are right-aligned except the indices
    in `left`.
    """
    longest = [max(map(len, column)) for column in zip(*rows, strict=True)]
    widths = [-width if k in left else width for k, width in enumerate(longest)]
    return "\n".join(format_line(row, widths) for row in rows)


def format_line(cells: Sequence[object], widths: Sequence[int]) -> str:
    """Return one row of cells as a line of text; a column of negative width is left-aligned."""
    columns = zip(cells, widths, strict=True)
    return "  ".join(f"{cell!s:{'<' if w < 0 else '>'}{abs(w)}}" for cell, w in columns).rstrip()


@contextlib.contextmanager
def hold_folder(folder: Path) -> Iterator[None]:
    """Create and lock a folder within the context; remove half-written files. A folder in use
    raises `OutputError`.
    """
    with _hold("folder", folder, folder / LOCK):
        _remove_parts(folder.rglob(f".*{ENDING}"))
        yield


@contextlib.contextmanager
def hold_file(path: Path) -> Iterator[None]:
    """Lock a file within the context by a lock file beside it; remove half-written copies of
    broken-off runs.
    """
    with _hold("path", path, path.with_name(f".{path.name}{LOCK}")):
        _remove_parts(
            x for x in path.parent.glob(f".*{ENDING}") if x.name.startswith(f".{path.name}.")
        )
        yield


def begin_folder(path: Path, content: str, what: str) -> None:
    """Write a file that describes its folder; raise `OutputError` if the folder holds other files
    or other content.
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
    """Raise `OutputError` if the folder of a describing file has other files and not this one."""
    folder = path.parent
    if not path.exists() and {*folder.glob("*")} - {folder / LOCK, *folder.glob(f".*{ENDING}")}:
        raise OutputError("folder", f"{folder}, which holds other files", "an empty folder")


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """Create a temporary folder, and remove it at the end of the context."""
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
    """Remove half-written files of an interrupted run; the lock ensures that no run is writing
    them.
    """
    for part in list(paths):
        with contextlib.suppress(OSError):
            part.unlink()
