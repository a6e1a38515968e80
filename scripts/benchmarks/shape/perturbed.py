"""What a shape loses by what a robot does not know: each error of its calibration and its camera,
and all together.
"""

from collections.abc import Iterator
from pathlib import Path

from tqdm import tqdm

from benchmarks.common import Options, Row, bench, mean_over
from benchmarks.ground_truth import read_views
from benchmarks.perturb import PERTURBATIONS, find_perturbation, perturb_view
from benchmarks.shape.accuracy import Row as View
from benchmarks.shape.accuracy import measure_shape
from torchgrasp.data import read_entry
from torchgrasp.evaluation.protocols import seed_of
from torchgrasp.shape.fit import fit_shape

FACTORS = tuple(name for name in PERTURBATIONS if name not in ("mass", "friction", "pose"))
"""What changes the cloud or the table; the other factors come after planning."""
COLUMNS = {
    "hidden_median_mm": ("median", 1.0, "{:.1f} mm"),
    "hidden_p90_mm": ("90 %", 1.0, "{:.1f} mm"),
    "hidden_normal_deg": ("normals", 1.0, "{:.0f} degrees"),
    "hidden_within_1": ("within 1 std_m", 100.0, "{:.0f} %"),
    "hidden_within_2": ("within 2 std_m", 100.0, "{:.0f} %"),
}
"""Numbers of the hidden surface: their names, factors and formats."""


@bench("shape/weaker", objects=True)
def weaker(o: Options) -> list[Row]:
    """Measure the hidden surface under the perturbations of camera and table."""
    return bench_weaker(o.objects[0], o.views, o.seed)


def bench_weaker(objects: Path, views: tuple[str, ...], seed: int) -> list[Row]:
    """Return a row for each group and factor: the hidden surface's errors, and their change over
    nothing wrong.

    The truth stays where it is, so an error of the camera's pose counts as an error of the surface.
    """
    found = {factor: list(_measure(objects, views, factor, seed)) for factor in FACTORS}
    groups = sorted({str(view["group"]) for view in found["none"]})
    return [
        _row(f"{group or 'all'}, {factor}", _of(found[factor], group), _of(found["none"], group))
        for group in groups
        for factor in FACTORS
    ]


def _measure(objects: Path, views: tuple[str, ...], factor: str, seed: int) -> Iterator[View]:
    """Yield the errors of every view with one factor wrong, with its object, family and group."""
    perturbation = find_perturbation(factor)
    for name, view, cloud, mesh in tqdm(
        list(read_views(objects, views=views)), desc=factor, disable=None, leave=False
    ):
        seen, table = perturb_view(cloud, perturbation, seed_of(seed, name, view))
        entry = read_entry(objects, name)
        told = {"object": name, "family": entry.family, "group": entry.group}
        yield told | measure_shape(fit_shape(seen, table=table), mesh, cloud)


def _of(found: list[View], group: str) -> list[View]:
    """Return the views of one group."""
    return [view for view in found if view["group"] == group]


def _row(what: str, found: list[View], clean: list[View]) -> Row:
    """Return means over views, and their changes with intervals over families."""
    cells = []
    numbers = {}
    for key, (name, factor, form) in COLUMNS.items():
        mean = mean_over((str(view["family"]), factor * view[key]) for view in found)
        pairs = zip(found, clean, strict=True)
        change = mean_over(
            (str(view["family"]), factor * (view[key] - before[key])) for view, before in pairs
        )
        cells.append(
            f"{name} {form.format(mean.value)} ({change.value:+.1f} [{change.low:+.1f}, {change.high:+.1f}])"
        )
        numbers[key] = {"mean": mean.value, "change": list(change[:3])}
    return Row(
        f"hidden surface of {len(found)} views, {what}", "-", "; ".join(cells), None, numbers
    )
