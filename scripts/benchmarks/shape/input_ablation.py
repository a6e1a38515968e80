"""What a shape loses without the table or the camera, and gains by a second view; rows without a bar."""

from itertools import groupby
from pathlib import Path

import torch
from tqdm import tqdm

from benchmarks.common import Row
from benchmarks.ground_truth import read_views
from benchmarks.shape.accuracy import Row as View
from benchmarks.shape.accuracy import mean_row, measure_accuracy, measure_shape
from torchgrasp.cloud.merge import merge_clouds
from torchgrasp.shape.fit import fit_shape

WEAKER = {
    "neither missing": (True, True),
    "no table plane": (True, False),
    "no camera known": (False, True),
    "no camera known, no table plane": (False, False),
}
"""What is missing, and whether the camera and the table are given."""


def bench_inputs(objects: Path) -> list[Row]:
    """Measure the hidden side of a folder's views with less given, and with two views merged, of each object."""
    rows = []
    for missing, (camera, table) in tqdm(WEAKER.items(), desc="inputs", disable=None, leave=False):
        found = mean_row(measure_accuracy(objects, camera=camera, table=table))
        rows.append(_row(f"hidden surface, one view, {missing}", found))
    one, two = _merge_two(objects)
    rows.append(_row("surface that the first view did not see, no table plane: that view alone", one))
    rows.append(_row("the same surface with the second view merged", two))
    return rows


def _merge_two(objects: Path) -> tuple[View, View]:
    """Return the mean errors where the first view saw nothing: of its shape, and of that of the first two views."""
    alone, merged = [], []
    for _, views in groupby(read_views(objects), lambda view: view[0]):
        (_, _, first, mesh), (_, _, second, _), *_ = views
        both = merge_clouds([first, second], [torch.eye(4, dtype=torch.float64)] * 2)
        alone.append(measure_shape(fit_shape(first), mesh, first))
        merged.append(measure_shape(fit_shape(both), mesh, first))
    return mean_row(alone), mean_row(merged)


def _row(what: str, found: View) -> Row:
    """Return a row of errors and coverage, which no bar judges."""
    keys = ("median_mm", "p90_mm", "normal_deg", "within_1", "within_2")
    numbers = {key: found[f"hidden_{key}"] for key in keys}
    text = "{:.1f} / {:.1f} mm, {:.1f} degrees, {:.0%} and {:.0%} within one and two std_m".format(*numbers.values())
    return Row(what, "none", text, None, numbers)
