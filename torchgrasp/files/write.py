"""Files are written under another name, flushed to the disk, and moved into place. Also JSON and tables as text."""

import contextlib
import hashlib
import io
import json
import math
import os
import tempfile
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import IO, Any

from torchgrasp.errors import OutputError, Status

ENDING = ".part"  # ending of the name under which a file is written; a dot and the name of the file come first


def write_file(path: Path | str, content: str | bytes | Callable[[IO[bytes]], object]) -> Path:
    """Write a file, text as UTF-8. Readers find the old content or the new one, whatever happens.

    Args:
        path: of the file; its folder is made.
        content: or a function that writes the content into the file object that it gets.

    Raises:
        OutputError: the folder cannot be written, or the disk is full. Nothing half-written is left.
    """
    path, data = Path(path), content.encode() if isinstance(content, str) else content
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
            os.chmod(part, 0o644)
            os.replace(part, path)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(part)
            raise
    except OSError as error:
        raise OutputError("path", f"{path} ({error.strerror or error})", "a file in a writable folder") from error
    return path


def remove_file(path: Path) -> None:
    """Remove a file, if it is there; raise `OutputError` if it cannot be removed."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError("path", f"{path} ({error.strerror or error})", "a file that can be removed") from error


def is_file(path: Path | str) -> bool:
    """Return whether a path is that of a regular file; a path of a wrong type or length is not."""
    try:
        return Path(path).is_file()
    except (OSError, TypeError, ValueError):
        return False


def read_bytes(path: Path | str) -> bytes:
    """Return the content of a file up to the size that it reports: some files of the system never end."""
    with Path(path).open("rb") as file:
        return file.read(os.fstat(file.fileno()).st_size)


def sha256(path: Path | str) -> str:
    """Return the SHA-256 of a file in hexadecimal digits."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def format_json(value: Any) -> str:
    """Return a value as JSON; a status becomes its name, NaN and infinity become null."""
    return json.dumps(_plain(value), indent=1)


def _plain(value: Any) -> Any:
    """Replace statuses, NaN and infinity, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _plain(x) for key, x in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(x) for x in value]
    if isinstance(value, Status):
        return value.name
    return None if isinstance(value, float) and not math.isfinite(value) else value


def format_columns(rows: Sequence[Sequence[str]], left: Collection[int] = ()) -> str:
    """Return rows as lines of text; columns are flush right except those in `left`."""
    longest = [max(map(len, column)) for column in zip(*rows, strict=True)]
    widths = [-width if k in left else width for k, width in enumerate(longest)]
    return "\n".join(format_line(row, widths) for row in rows)


def format_line(cells: Sequence[object], widths: Sequence[int]) -> str:
    """Return one row as a line of text; a column of negative width is flush left."""
    columns = zip(cells, widths, strict=True)
    return "  ".join(f"{cell!s:{'<' if w < 0 else '>'}{abs(w)}}" for cell, w in columns).rstrip()
