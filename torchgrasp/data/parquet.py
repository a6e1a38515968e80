"""A campaign's data set as Parquet files with a Croissant card, which other libraries load in one
line.
"""

import itertools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from torchgrasp.data.reader import CARD, GraspShards
from torchgrasp.data.shards import JobRow, shard_ranges
from torchgrasp.data.table_folder import (
    as_column,
    as_table,
    import_arrow,
    pack_table,
    render_card,
    write_folder,
)
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, ModelFileError, Status
from torchgrasp.foundation.lazy import jinja2

OBJECT = ("object", "view", "family", "group")
"""Columns of every table that name the object and the view of a line."""


@checked
def write_parquet(data: GraspShards, folder: Path | str) -> Path:
    """Write a data set as Parquet files, with cards in Markdown and Croissant; return the folder.

    The package `datasets` reads it. `load_dataset(folder)` has a row for each grasp. A row holds
    the tensors of `data[i]` without the cloud, and the status of each simulated trial. It also
    names object, view, hand, friction and seed. `load_dataset(folder, "views")` has a row for each
    job, one view of one object: its cloud, its status and its counts. The cards name the joints.

    Args:
        data: the data set, as `read_shards` opens it.
        folder: the folder to write.

    Raises:
        BadArgument: the data set has no grasps.
        ModelFileError: a shard or the card is damaged.
        OutputError: the folder holds other files, or cannot be written.
        MissingExtra: pyarrow is not installed.

    >>> write_parquet(read_shards("campaign"), "parquet")  # doctest: +SKIP
    """
    import_arrow()
    if not len(data):
        found = f"{len(data.jobs)} jobs without a grasp"
        raise BadArgument("data", found, "a data set with grasps")
    try:
        source = {name: data.card[name] for name in ("campaign", "licence", "asked")}
        asked = source["asked"]
        trial = asked["protocol"]["trial"]
        of_campaign = {name: asked[name]["name"] for name in ("hand", "protocol")}
        of_campaign |= {
            "simulator": trial["simulator"],
            "friction": trial["friction"],
            "seed": asked["trials"]["seed"],
        }
        render_card("shards.md", card=data.card)
    except (LookupError, TypeError, jinja2.TemplateError) as error:
        found = f"{data.folder / CARD} ({error})"
        raise ModelFileError("data", found, "the card of `torchgrasp campaign`") from error
    return write_folder(folder, source, _files(data, of_campaign))


def _files(data: GraspShards, of_campaign: dict[str, Any]) -> Iterator[tuple[str, str | bytes]]:
    """Yield names and contents of the files: for each shard its tables, at the end the cards."""
    schemas: dict[str, Any] = {}
    meta = {"torchgrasp": json.dumps(data.card["asked"]["hand"])}
    for k, jobs in enumerate(shard_ranges(len(data.jobs), data.size)):
        for name, columns in (
            ("views", _view_columns(data, jobs)),
            ("grasps", _grasp_columns(data, jobs, of_campaign)),
        ):
            if columns:
                table = as_table(columns, meta)
                schemas[name] = [_describe(field) for field in table.schema]
                yield f"{name}/shard-{k:06d}.parquet", pack_table(table)
    tables = {name: schemas[name] for name in ("grasps", "views")}
    yield "README.md", render_card("parquet.md", card=data.card, tables=tables)
    yield "croissant.json", render_card("croissant.json", card=data.card, tables=tables)


def _grasp_columns(data: GraspShards, jobs: range, of_campaign: dict[str, Any]) -> dict[str, Any]:
    """Return the columns of the grasps of some jobs by name, or none if the jobs have no grasp."""
    numbers = range(data.starts[jobs.start], data.starts[jobs.stop])
    items = [data[i] for i in numbers]
    if not items:
        return {}
    of = [int(item["job"]) for item in items]
    columns: dict[str, Any] = {"grasp": list(numbers), "job": of}
    columns |= _of_rows([data.jobs[j] for j in of], OBJECT)
    columns |= {name: [value] * len(items) for name, value in of_campaign.items()}
    for name in items[0]:
        if name not in ("job", "points", "viewpoint"):  # of the view
            columns[name] = torch.stack([x[name] for x in items])
    tries = itertools.chain(*(data.job(j).outcome.tolist() for j in jobs))
    columns["outcomes"] = [[Status(status).name for status in of_grasp] for of_grasp in tries]
    return columns


def _of_rows(rows: Sequence[JobRow], names: Sequence[str]) -> dict[str, list[Any]]:
    """Return columns of some fields of the rows of jobs."""
    return {name: [getattr(row, name) for row in rows] for name in names}


def _view_columns(data: GraspShards, jobs: range) -> dict[str, Any]:
    """Return the columns of some jobs by name; a view without a known camera has no viewpoint."""
    arrow = import_arrow()
    rows = data.jobs[jobs.start : jobs.stop]
    clouds = [data.job(j).cloud for j in jobs]
    places = arrow.list_(arrow.float32(), 3)
    points = [torch.zeros(0, 3) if x is None else x.points for x in clouds]
    eyes = [None if x is None or x.viewpoint is None else x.viewpoint.tolist() for x in clouds]
    ends = arrow.array([0, *itertools.accumulate(map(len, points))], arrow.int32())
    rows_of_points = as_column(torch.cat(points).float())
    return {
        "job": list(jobs),
        **_of_rows(rows, OBJECT),
        "status": [row.status.name for row in rows],
        **_of_rows(rows, ("note", "executable", "grasps", "passed")),
        "viewpoint": arrow.array(eyes, places),
        "points": arrow.ListArray.from_arrays(ends, rows_of_points),
    }


def _describe(field: Any) -> dict[str, str]:
    """Return name, kind and shape of a column. A length that differs from row to row is -1 in the
    shape.
    """
    kind = field.type
    shape = list[str]()
    while hasattr(kind, "value_type"):
        shape.append(str(getattr(kind, "list_size", -1)))
        kind = kind.value_type
    return {"name": field.name, "kind": str(kind), "shape": ",".join(shape)}
