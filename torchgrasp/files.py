"""Files: safetensors with JSON metadata, atomic writes, locked folders.

Nothing here is pickled: a file from a stranger can be malformed, but it cannot run code.
"""

import contextlib
import hashlib
import json
import math
import os
import socket
import tempfile
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock, Timeout
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from torchgrasp.errors import ModelFileError, OutputError, Status

VERSION = "1"
"""Version of the file layout; readers refuse any other."""

DTYPES = (torch.float32, torch.float64, torch.int64, torch.bool)
"""Types of numbers in our files. Of others, such as float8, torch cannot even tell which are finite."""

LOCK = ".lock"
"""Name of the lock file in a folder; the file names the run that holds the lock."""


@contextlib.contextmanager
def hold_folder(folder: Path) -> Iterator[None]:
    """Make a folder and lock it against other runs; the system frees the lock when the process ends.

    A new folder that is still empty at the end is removed.

    Raises:
        OutputError: another run holds the lock, or the folder cannot be written.
    """
    path, made = folder / LOCK, [x for x in (folder, *folder.parents) if not x.exists()]
    lock = FileLock(path, timeout=0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except Timeout as error:
        raise OutputError("folder", f"{folder}, in use by {_holder(path)}", "a folder that no run writes") from error
    except OSError as error:
        raise OutputError("folder", f"{folder} ({error.strerror or error})", "a folder that can be written") from error
    try:
        with contextlib.suppress(OSError):  # some systems let nobody write a locked file
            path.write_text(f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8")
        yield
    finally:
        lock.release()
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
            for empty in made:
                empty.rmdir()


def is_file(path: Path | str) -> bool:
    """Tell whether a path is that of a regular file; a path of a wrong type or length is not."""
    try:
        return Path(path).is_file()
    except (OSError, TypeError, ValueError):  # a name of more than 255 letters, a number, a NUL
        return False


def _holder(path: Path) -> str:
    """Return which run holds a lock, as far as its file tells."""
    try:
        return path.read_text(encoding="utf-8")[:200].strip() or "another run"
    except (OSError, UnicodeDecodeError):
        return "another run"


def write_atomically(path: Path | str, write: Callable[[Path], object]) -> Path:
    """Call `write` on a temporary file beside `path`, then move the file into place.

    Raises:
        OutputError: the folder cannot be written, or the disk is full. Nothing half-written stays.
    """
    path = Path(path)
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        write(temporary)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except OSError as error:
        raise OutputError("path", f"{path} ({error.strerror or error})", "a file in a writable folder") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
    return path


def write_file(path: Path | str, content: str | bytes) -> Path:
    """Write a file atomically, text as UTF-8."""
    data = content.encode() if isinstance(content, str) else content
    return write_atomically(path, lambda temporary: temporary.write_bytes(data))


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


def save_tensors(path: Path | str, kind: str, tensors: dict[str, Tensor], meta: dict[str, str]) -> Path:
    """Write tensors and metadata as one safetensors file of a `kind`, such as "grasps".

    Raises:
        OutputError: the file cannot be written.
    """
    contiguous = {name: t.detach().cpu().contiguous().clone() for name, t in tensors.items()}  # a file shares no memory
    # One JSON string: safetensors writes several metadata keys in random order, and equal values must give equal bytes.
    header = {"torchgrasp": json.dumps({**meta, "kind": kind, "version": VERSION}, sort_keys=True)}
    # as bytes, since a full disk then is an OSError, which save_file makes an error of its own
    return write_file(path, save(contiguous, header))


def load_tensors(
    path: Path | str, kind: str, names: set[str], optional: Collection[str] = ()
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read a safetensors file of a `kind` that holds the tensors `names`, and of others at most the `optional`.

    Raises:
        ModelFileError: the file is missing or malformed, has another kind, version or tensors, or a number is not
            finite.
    """
    allowed = names.union(optional)
    if not is_file(path):
        raise ModelFileError("path", f"{path}, which is no file", f"a safetensors file of kind {kind!r}")
    try:
        with safe_open(path, framework="pt") as file:
            meta = json.loads((file.metadata() or {}).get("torchgrasp", "{}"))
            found = set(file.keys())
            tensors = {name: file.get_tensor(name) for name in found & allowed}  # nothing else is worth its memory
    except (SafetensorError, OSError, ValueError, KeyError, RecursionError) as error:
        raise ModelFileError("path", f"{path}: {error}", f"a safetensors file of kind {kind!r}") from error
    if not isinstance(meta, dict) or not all(isinstance(x, str) for x in meta.values()):
        raise ModelFileError("path", f"{path}: metadata that is no object of texts", f"kind {kind!r}")
    if meta.get("kind") != kind or meta.get("version") != VERSION:
        other = f"kind {meta.get('kind')!r}, version {meta.get('version')!r}"
        raise ModelFileError("path", f"{path}: {other}", f"kind {kind!r}, version {VERSION!r}")
    if not names <= found <= allowed:
        raise ModelFileError("path", f"{path}: tensors {sorted(found)}", f"tensors {sorted(names)}")
    for name, t in tensors.items():
        if t.dtype not in DTYPES:
            raise ModelFileError("path", f"{path}: {name} of {t.dtype}", f"one of {', '.join(map(str, DTYPES))}")
        if t.is_floating_point() and not bool(torch.isfinite(t).all()):
            raise ModelFileError("path", f"{path}: a non-finite number in {name}", "finite numbers")
    return tensors, meta


def sha256(path: Path | str) -> str:
    """Return the SHA-256 of a file in hexadecimal digits."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
