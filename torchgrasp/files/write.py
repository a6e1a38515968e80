"""Files appear whole or not at all: written under another name, flushed to the disk, then moved into place."""

import contextlib
import io
import json
import math
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from torchgrasp.errors import OutputError, Status
from torchgrasp.files.own import abandoned, own

ENDING = ".part"
"""Ending of the name under which a file is written; the dot and the name of the file come first."""


def write_file(path: Path | str, content: str | bytes | Callable[[IO[bytes]], object]) -> Path:
    """Write a file, text as UTF-8; whoever reads it finds the old content or the new one, whatever happens.

    What a killed process left of the same file is removed. A function as content writes into the file that it is given.

    Raises:
        OutputError: the folder cannot be written, or the disk is full. Nothing half-written stays.
    """
    path, data = Path(path), content.encode() if isinstance(content, str) else content
    if not isinstance(data, bytes):
        buffer = io.BytesIO()
        data(buffer)
        data = buffer.getvalue()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_remnants(path)
        file = _open_part(path)
        try:
            left = memoryview(data)
            while len(left):
                left = left[os.write(file.fileno(), left) :]
            os.fsync(file.fileno())  # or a power cut could leave the name without the content
            os.chmod(file.name, 0o644)
            if os.name == "nt":  # which moves no open file
                file.close()
            os.replace(file.name, path)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(file.name)
            raise
        finally:
            file.close()
    except OSError as error:
        raise OutputError("path", f"{path} ({error.strerror or error})", "a file in a writable folder") from error
    return path


def remove_file(path: Path) -> None:
    """Remove a file, if it is there.

    Raises:
        OutputError: it cannot be removed.
    """
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError("path", f"{path} ({error.strerror or error})", "a file that can be removed") from error


def is_remnant(name: str, of: str = "") -> bool:
    """Tell whether a name is that of a file not yet moved into place.

    >>> is_remnant(".grasps.safetensors.8_wc2xvo.part", "grasps.safetensors"), is_remnant("report.html")
    (True, False)
    """
    return name.startswith(f".{of}." if of else ".") and name.endswith(ENDING)


def _open_part(path: Path) -> Any:
    """Return a new open file beside a path."""
    while True:
        file = tempfile.NamedTemporaryFile(
            "wb", buffering=0, prefix=f".{path.name}.", suffix=ENDING, dir=path.parent, delete=False
        )
        if own(file.fileno()):
            return file
        file.close()


def _remove_remnants(path: Path) -> None:
    """Remove what killed processes left of a file."""
    with os.scandir(path.parent) as entries:
        found = [entry.path for entry in entries if is_remnant(entry.name, path.name)]
    for remnant in found:
        with abandoned(remnant) as free, contextlib.suppress(OSError):
            if free:
                os.unlink(remnant)


def format_json(value: Any) -> str:
    """Return a value as JSON; a status becomes its name, NaN and infinity become null.

    >>> format_json({"force": float("nan"), "status": Status.OK}).split()
    ['{', '"force":', 'null,', '"status":', '"OK"', '}']
    """
    return json.dumps(_plain(value), indent=1)


def _plain(value: Any) -> Any:
    """Replace statuses, NaN and infinity, which JSON lacks."""
    if isinstance(value, dict):
        return {key: _plain(x) for key, x in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(x) for x in value]
    if isinstance(value, Status):
        return value.name
    return None if isinstance(value, float) and not math.isfinite(value) else value
