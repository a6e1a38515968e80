"""Output folders and files that one run locks against all others. The system frees a lock when its process ends."""

import contextlib
import os
import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from torchgrasp.errors import OutputError
from torchgrasp.files.write import ENDING, write_file

LOCK = ".lock"  # name of the lock file in a folder. It holds the process and host of the run.


@contextlib.contextmanager
def hold_folder(folder: Path) -> Iterator[None]:
    """Make a folder and lock it against other runs; remove what a killed run left half-written in it.

    A new folder that is still empty at the end is removed.

    Raises:
        OutputError: another run holds the lock, or the folder cannot be written.
    """
    with _hold("folder", folder, folder / LOCK):
        _remove_parts(folder.rglob(f".*{ENDING}"))
        yield


@contextlib.contextmanager
def hold_file(path: Path) -> Iterator[None]:
    """Lock a file against other runs by a lock file beside it; remove what a killed run left of it half-written.

    Raises:
        OutputError: another run holds the lock, or the file's folder cannot be written.
    """
    with _hold("path", path, path.with_name(f".{path.name}{LOCK}")):
        _remove_parts(x for x in path.parent.glob(f".*{ENDING}") if x.name.startswith(f".{path.name}."))
        yield


def begin_folder(path: Path, content: str, what: str) -> None:
    """Begin a held folder with the file that describes it, or check that it began with the same file.

    Raises:
        OutputError: the folder holds other content of the kind `what`, or other files.
    """
    folder = path.parent
    if path.exists():
        if path.read_text("utf-8", errors="replace") != content:
            raise OutputError("folder", f"{folder}, which holds other {what}", f"an empty folder, or the same {what}")
    elif any(x.name != LOCK for x in folder.iterdir()):
        raise OutputError("folder", f"{folder}, which holds other files", "an empty folder")
    else:
        write_file(path, content)


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """Make a folder among the system's temporary ones, and remove it at the end."""
    with tempfile.TemporaryDirectory(prefix="torchgrasp-", ignore_cleanup_errors=True) as folder:
        yield Path(folder)


@contextlib.contextmanager
def _hold(argument: str, what: Path, path: Path) -> Iterator[None]:
    """Lock a folder or a file by a lock file at a path."""
    folder = path.parent
    made = [x for x in (folder, *folder.parents) if not x.exists()]
    lock = FileLock(path, timeout=0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except Timeout as error:
        allowed = f"a {'folder' if argument == 'folder' else 'file'} that no other run writes"
        raise OutputError(argument, f"{what}, in use by {_holder(path)}", allowed) from error
    except OSError as error:
        allowed = f"a {'folder' if argument == 'folder' else 'file in a folder'} that can be written"
        raise OutputError(argument, f"{what} ({error.strerror or error})", allowed) from error
    try:
        with contextlib.suppress(OSError):  # on some systems nobody can write a locked file
            path.write_text(f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8")
        yield
    finally:
        with contextlib.suppress(OSError):  # before the release: another run might lock the file before it is removed
            path.unlink(missing_ok=True)
        lock.release()
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True) if os.name == "nt" else None  # Windows removes no locked file
            for empty in made:
                empty.rmdir()


def _holder(path: Path) -> str:
    """Return the run that holds a lock, as its file says."""
    try:
        return path.read_text(encoding="utf-8")[:200].strip() or "another run"
    except (OSError, UnicodeDecodeError):
        return "another run"


def _remove_parts(paths: Iterator[Path]) -> None:
    """Remove half-written files that a killed run left; the lock says that no run is writing them."""
    for part in list(paths):
        with contextlib.suppress(OSError):
            part.unlink()
