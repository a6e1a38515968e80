"""Folders and files that one run holds against all others; the system frees the lock when the run ends or dies."""

import contextlib
import os
import shutil
import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from torchgrasp.errors import OutputError
from torchgrasp.files.own import abandoned, own
from torchgrasp.files.write import is_remnant, write_file

LOCK = ".lock"
"""Name of the lock file in a folder; the file names the run that holds the lock."""

TEMPORARY = "torchgrasp-"
"""Beginning of the names of our folders among the system's temporary ones."""


@contextlib.contextmanager
def hold_folder(folder: Path) -> Iterator[None]:
    """Make a folder and lock it against other runs. A new folder that is still empty at the end is removed.

    Raises:
        OutputError: another run holds the lock, or the folder cannot be written.
    """
    with _hold("folder", folder, folder / LOCK):
        yield


def begin_folder(path: Path, content: str, what: str) -> None:
    """Begin a folder by the file that says what it is to hold, or check that it was begun so.

    Raises:
        OutputError: it holds other things of the kind `what`, or other files.
    """
    folder = path.parent
    if path.exists():
        if path.read_text("utf-8", errors="replace") != content:
            raise OutputError("folder", f"{folder}, which holds other {what}", f"an empty folder, or the same {what}")
    elif any(x.name != LOCK and not is_remnant(x.name) for x in folder.iterdir()):
        raise OutputError("folder", f"{folder}, which holds other files", "an empty folder")
    else:
        write_file(path, content)


@contextlib.contextmanager
def hold_file(path: Path) -> Iterator[None]:
    """Lock a file that is to be written against other runs, by a lock file beside it.

    Raises:
        OutputError: another run holds the lock, or the file's folder cannot be written.
    """
    with _hold("path", path, path.with_name(f".{path.name}{LOCK}")):
        yield


@contextlib.contextmanager
def _hold(argument: str, what: Path, path: Path) -> Iterator[None]:
    """Lock what is named by a lock file at a path."""
    folder = path.parent
    made = [x for x in (folder, *folder.parents) if not x.exists()]
    lock = FileLock(path, timeout=0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except Timeout as error:
        allowed = f"a {'folder' if argument == 'folder' else 'file'} that no run writes"
        raise OutputError(argument, f"{what}, in use by {_holder(path)}", allowed) from error
    except OSError as error:
        allowed = f"a {'folder' if argument == 'folder' else 'file in a folder'} that can be written"
        raise OutputError(argument, f"{what} ({error.strerror or error})", allowed) from error
    try:
        with contextlib.suppress(OSError):  # some systems let nobody write a locked file
            path.write_text(f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8")
        yield
    finally:
        with contextlib.suppress(OSError):  # while it is held: another run might lock it before it is gone
            path.unlink(missing_ok=True)
        lock.release()
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True) if os.name == "nt" else None  # which removes no locked file
            for empty in made:
                empty.rmdir()


def _holder(path: Path) -> str:
    """Return which run holds a lock, as far as its file tells."""
    try:
        return path.read_text(encoding="utf-8")[:200].strip() or "another run"
    except (OSError, UnicodeDecodeError):
        return "another run"


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """Make a folder in the system's temporary one, removed at the end; those of dead processes are removed at once."""
    home = tempfile.gettempdir()
    with os.scandir(home) as entries:
        found = [entry.path for entry in entries if entry.name.startswith(TEMPORARY)]
    for remnant in found:
        with abandoned(remnant) as free:
            if free:
                shutil.rmtree(remnant, ignore_errors=True)
    while True:
        folder = tempfile.mkdtemp(prefix=TEMPORARY, dir=home)
        try:
            handle = None if os.name == "nt" else os.open(folder, os.O_RDONLY)  # Windows opens no folder
        except FileNotFoundError:  # another process took it for abandoned, before it could be locked
            continue
        if handle is None or own(handle):
            break
        os.close(handle)
    try:
        yield Path(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if handle is not None:
            os.close(handle)
