"""What a path leads to."""

import hashlib
from pathlib import Path


def is_file(path: Path | str) -> bool:
    """Tell whether a path is that of a regular file; a path of a wrong type or length is not."""
    try:
        return Path(path).is_file()
    except (OSError, TypeError, ValueError):  # a name of more than 255 letters, a number, a NUL
        return False


def sha256(path: Path | str) -> str:
    """Return the SHA-256 of a file in hexadecimal digits."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
