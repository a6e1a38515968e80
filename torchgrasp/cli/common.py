"""Checks that the commands share, and errors that name the option."""

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

from torchgrasp.base import check_whole
from torchgrasp.cloud.io.read import read_cloud
from torchgrasp.errors import BadArgument, OutputError
from torchgrasp.values import PointCloud


@contextlib.contextmanager
def naming(**options: str) -> Iterator[None]:
    """Name options in errors, by the argument that each stands for."""
    try:
        yield
    except BadArgument as error:
        if error.argument not in options:
            raise
        raise type(error)(options[error.argument], error.found, error.allowed) from error


def read_view(option: str, path: Path, viewpoint: tuple[float, float, float] | None) -> PointCloud:
    """Read the cloud of an option."""
    with naming(path=option, points=option, normals=option, viewpoint="--viewpoint"):
        return read_cloud(path, viewpoint)


def check_folder(path: Path) -> None:
    """Refuse a folder that cannot be written, by a trial."""
    made: list[Path] = []
    try:
        for folder in reversed([path, *path.parents]):
            if not folder.exists():
                folder.mkdir()
                made.append(folder)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise OutputError("path", f"{path} ({error.strerror or error})", "a folder that can be written") from error
    finally:
        for folder in reversed(made):
            folder.rmdir()


def check_seed(seed: int) -> None:
    """Refuse a seed that no generator takes."""
    check_whole("--seed", seed, 0, 2**63 - 1)


def table_height(cloud: PointCloud, table: float | None, no_table: bool) -> float | None:
    """Return the table's height [m], by default the cloud's lowest point."""
    if table is not None and no_table:
        raise BadArgument("--table", f"{table:g} and --no-table", "one of the two")
    return None if no_table else float(cloud.points[:, 2].min()) if table is None else table
