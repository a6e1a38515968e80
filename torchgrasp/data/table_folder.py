"""Folders of tables and cards, which libraries such as Hugging Face's `datasets` read."""

import importlib
import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from torchgrasp.files import begin_folder, format_json, hold_folder, render, write_file
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.lazy import import_extra

SOURCE = "source.json"  # file that says what a folder of tables is made from


def import_arrow() -> Any:
    """Return the module pyarrow, with `pyarrow.parquet`.

    Raises `MissingExtra` if it is not installed.
    """
    import_extra("pyarrow.parquet", "data", "pyarrow")
    return importlib.import_module("pyarrow")


def as_column(rows: Tensor) -> Any:
    """Return a tensor (n, ...) as a column of a pyarrow table, with n entries.

    An entry is a number if the tensor has one axis. Otherwise it is a nested list of numbers, with
    the sizes of the other axes.
    """
    arrow = import_arrow()
    column = arrow.array(rows.cpu().reshape(-1).numpy())
    for size in reversed(rows.shape[1:]):
        column = arrow.FixedSizeListArray.from_arrays(column, size)
    return column


def as_table(columns: Mapping[str, Any], meta: Mapping[str, str]) -> Any:
    """Return a pyarrow table, given its columns by name and its metadata `meta`.

    A column is whatever pyarrow takes, or a tensor, whose first axis counts the rows of the table.
    """
    cells = {name: as_column(x) if isinstance(x, Tensor) else x for name, x in columns.items()}
    return import_arrow().table(cells).replace_schema_metadata(dict(meta))


def pack_table(table: Any) -> bytes:
    """Return the bytes of a Parquet file with the content of a pyarrow table."""
    buffer = io.BytesIO()
    # Without dictionaries: hardly any number comes twice.
    import_arrow().parquet.write_table(table, buffer, compression="zstd", use_dictionary=False)
    return buffer.getvalue()


def render_card(template: str, **values: Any) -> str:
    """Return the text of a card, the description of a data set, made from a Jinja template.

    `template` is the file's name in `torchgrasp/data/templates`, without ".jinja". `values` are
    the template's variables by name.
    """
    return render(
        Path(__file__).parent / "templates" / f"{template}.jinja", Status=Status, **values
    )


def write_folder(
    folder: Path | str, source: Mapping[str, Any], files: Iterable[tuple[str, str | bytes]]
) -> Path:
    """Write files into a folder of their own, one by one; return the folder.

    `files` are pairs of name and content. `source` says what the files are made from, and is
    written to `source.json`. Raises `OutputError` if the folder holds other files, or files from
    another source, or cannot be written.
    """
    folder = Path(folder)
    with hold_folder(folder):
        begin_folder(folder / SOURCE, format_json(source) + "\n", "data")
        for name, content in files:
            write_file(folder / name, content)
    return folder
