"""What a path leads to."""

import hashlib
import os
from pathlib import Path


def is_file(path: Path | str) -> bool:
    """Tell whether a path is that of a regular file; a path of a wrong type or length is not."""
    try:
        return Path(path).is_file()
    except (OSError, TypeError, ValueError):  # a name of more than 255 letters, a number, a NUL
        return False


def read_bytes(path: Path | str) -> bytes:
    """Return the content of a file, as long as it says it is: the system's own files say 0, and some never end."""
    with Path(path).open("rb") as file:
        return file.read(os.fstat(file.fileno()).st_size)


def sha256(path: Path | str) -> str:
    """Return the SHA-256 of a file in hexadecimal digits."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
