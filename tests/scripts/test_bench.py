"""scripts/bench.py and scripts/train.py: each bench runs on its smallest case; measures agree with
closed forms.
"""

import json
import math
import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from bench import SUBJECTS
from benchmarks import common
from benchmarks.common import Options, Row, benches_of, keep_rows, measure, write_section
from benchmarks.ground_truth import nearest_on_mesh, read_views, sample_mesh
from benchmarks.plan import beside, timed
from benchmarks.plan.exact_lp import (
    exact_margin,
    proves_margin_above,
    proves_margin_below,
    wrench_matrix,
)
from benchmarks.shape.accuracy import find_edges, mean_row, measure_shape
from benchmarks.shape.walls import measure_walls
from train.bands import fit_factor

from tests.make import cup, cup_view
from torchgrasp import Contacts, ContactSpec, PointCloud, certify, fit_shape
from torchgrasp.contacts.form_closure import solve_closure_lp, wrenches
from torchgrasp.evaluation import PROTOCOLS
from torchgrasp.geometry.linalg import unit

RUNS = ("gpu/launches", "scene/rooms")
SIMULATED = ("close/where",)
SHORT = {"hold_time": 0.1, "control_rate": 50.0}
"""Trials whose verdicts do not matter."""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "name", [*RUNS, *(pytest.param(x, marks=pytest.mark.sim) for x in SIMULATED)]
)
def test_bench_writes_its_rows(name, tin, tmp_path, monkeypatch):
    monkeypatch.setitem(PROTOCOLS, "household", PROTOCOLS["household"].with_trial(**SHORT))
    subject, short = name.split("/")
    options = Options(
        (short,),
        (tin,),
        hands=("barrett",),
        starts=8,
        batches=(1,),
        scale=2e-4,
        workers=0,
        out=tmp_path / "out",
    )
    rows = measure(subject, options)
    assert len(rows) > 0
    written = json.loads((tmp_path / "out" / f"bench_{subject}.json").read_text())
    assert [row["what"] for row in written["rows"]] == [row.what for row in rows]
    table = (tmp_path / "out" / f"{subject}-{short}.md").read_text()
    assert "Commit " in table and table.count("\n| ") == len(rows) + 2


def test_benches_in_the_documentation_exist_or_have_a_commit():
    root = Path(__file__).parents[2]
    cited = re.compile(r"bench\.py (\w+) --only ([a-z]+(?:[ -][a-z]+)*)(.{0,130})", re.DOTALL)
    for path in (*(root / "docs").rglob("*.md"), *root.glob("*/README.md")):
        for subject, names, after in cited.findall(path.read_text()):
            known = benches_of(subject) if subject in SUBJECTS else {}
            assert set(names.split()) <= set(known) or "commit" in after, (path, subject, names)


def test_measure_refuses_an_unknown_bench():
    with pytest.raises(SystemExit, match="unknown; the benches of scene are"):
        measure("scene", Options(only=("nothing",)))


def test_rows_of_a_stopped_run_are_kept_for_the_same_commit_and_options(tmp_path, monkeypatch):
    untold = ["Commit 1 with changes"] * 2 + ["Commit unknown"] * 2
    runs = ["Commit 1", "Commit 1", "Commit 2", *untold]
    measured = list[str]()

    def measure_rows() -> list[Row]:
        measured.append(run)
        return [Row("a share", ">= 1", "0.5", False, {"of": {"tin": 2}})]

    for run in runs:
        monkeypatch.setattr(common, "describe_run", lambda threads, run=run: run)
        rows = keep_rows(Options(out=tmp_path), "bench", measure_rows)
        assert rows == [Row("a share", ">= 1", "0.5", False, {"of": {"tin": 2}})]
    assert measured == [runs[0], *runs[2:]]
    monkeypatch.setattr(common, "describe_run", lambda threads: "Commit 1")
    for options in (Options(out=tmp_path), Options(out=tmp_path, workers=2)):
        keep_rows(options, "bench", measure_rows)
    keep_rows(Options(out=tmp_path, starts=8), "bench", measure_rows)
    assert len(measured) == len(runs) + 1


class Slower:
    """Stands for a process that times a tree: its work takes so many times as long."""

    def __init__(self, factor: float, log: list[float]) -> None:
        self.factor = factor
        self.log = log

    def run(self, job: str, **arguments: object) -> dict[str, float]:
        self.log.append(self.factor)
        names = {"plan": ("first", "fifty", "all"), "cold": ("import", "command")}
        times = dict.fromkeys(names.get(job, ("shape", "predict")), self.factor)
        return times | ({"grasps": 30.0, "fifty": math.nan} if job == "plan" else {})


def test_times_beside_a_commit_are_taken_by_turns_and_become_ratios():
    log = list[float]()
    jobs = beside.list_jobs(["a", "b"], "allegro", Options(starts=8))
    found = beside.take_turns((Slower(1.0, log), Slower(4.0, log)), jobs)  # pyright: ignore
    assert log[:6] == [4.0, 1.0, 1.0, 4.0, 4.0, 1.0]
    rows = {row.what: row for row in beside.ratio_rows("two", *found, "abc")}
    first = rows["two: first executable grasp, median"]
    assert first.met and first.measured == "0.25x: 1 s beside 4 s at abc"
    rate = rows["two: executable grasps for each CPU second"]
    assert rate.met and rate.numbers == {"ratio": 4.0, "here": 30.0, "there": 7.5}
    # none of the plans had fifty
    assert rows["two: fifty executable grasps, median"].met is None


def test_a_view_that_is_timed_is_the_same_in_the_other_process(tin, tmp_path):
    _, _, cloud, _ = next(read_views(tin))
    path = beside.write_view(tmp_path / "view.npz", cloud)
    again = timed.read_view(str(path))
    assert torch.equal(again.points, cloud.points)
    assert torch.equal(again.viewpoint, cloud.viewpoint) and again.normals is None
    job = ["shape", {"view": str(path), "seed": 0}]
    times = json.loads(timed.answer(json.dumps(job)))
    assert set(times) == {"shape", "predict", "surface", "field"} and min(times.values()) > 0


def test_a_section_of_a_page_is_replaced(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# Page\n\n## Beside a\n\nold\n\n## Other\n\ntext\n")
    for measured in ("2", "3"):
        write_section(page, "Beside a", [Row("what", "-", measured)], Options())
    text = page.read_text()
    assert text.startswith("# Page\n\n## Other\n\ntext\n\n## Beside a\n")
    assert text.count("## Beside a") == 1 and text.endswith("| what | - | 3 | - |\n")
    assert "Commit " in text and "old" not in text


def ball(radius: float, n: int) -> torch.Tensor:
    return radius * unit(
        torch.randn(n, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    )


def test_measure_shape_of_a_larger_ball_is_the_difference_of_the_radii():
    points = ball(0.04, 2000)
    shape = fit_shape(PointCloud(points, unit(points)))
    cloud = PointCloud(points)
    row = measure_shape(shape, trimesh.creation.icosphere(subdivisions=4, radius=0.043), cloud)
    assert row["seen_median_mm"] == pytest.approx(3.0, abs=0.2) and row["seen_normal_deg"] < 4
    assert math.isnan(
        measure_shape(shape, trimesh.creation.icosphere(4, 0.04), cloud)["hidden_median_mm"]
    )
    assert mean_row([{"a": 1.0, "b": math.nan}, {"a": 3.0, "b": 5.0}]) == {"a": 2.0, "b": 5.0}


def test_measure_walls_of_a_cup_finds_its_thickness():
    cloud = cup_view(0.003)
    row = measure_walls(fit_shape(cloud, table=0.0), cup(0.003), cloud)
    assert abs(row["wall_mm"] - 3.0) < 0.1 and row["wall_off_mm"] < 1.5 and row["wall_holes"] < 0.03


def test_find_edges_marks_edges_but_not_thin_walls():
    points, normals = sample_mesh(
        trimesh.creation.box([0.1, 0.1, 0.004]), 3000, np.random.default_rng(0)
    )
    edge = find_edges(points, normals)
    off = points[:, :2].abs().amax(1)
    assert not bool(edge[off < 0.041].any()) and float(edge[off > 0.046].double().mean()) > 0.95


def test_nearest_on_mesh_is_exact_and_takes_the_facing_side():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.04)
    points = 1.2 * ball(0.04, 100)
    found, _ = nearest_on_mesh(mesh, points)
    distance = trimesh.proximity.closest_point_naive(mesh, points.numpy())[1]
    assert np.abs((found - points).norm(dim=-1).numpy() - distance).max() < 1e-4
    plate = trimesh.creation.box([0.1, 0.1, 0.002]).subdivide_to_size(0.01)
    below = torch.tensor([[0.01, 0.02, -0.0008]]).double()
    up = torch.tensor([[0.0, 0.0, 1.0]]).double()
    assert (
        nearest_on_mesh(plate, below)[1][0, 2] == -1
        and nearest_on_mesh(plate, below, up)[1][0, 2] == 1
    )


def test_exact_arithmetic_confirms_certificates(generator):
    points, lean = torch.randn(2, 10, 3, 3, generator=generator, dtype=torch.float64)
    normals = unit(unit(points - points.mean(1, keepdim=True)) + 0.4 * lean)
    found = certify(Contacts(points, normals), ContactSpec(friction=0.6, friction_margin=1.0))
    phi, _ = solve_closure_lp(wrenches(points, normals, 0.6, 8).flatten(1, 2))
    for i in range(10):
        matrix = wrench_matrix(points[i].numpy(), normals[i].numpy(), 0.6, 8)
        exact = exact_margin(matrix)
        little = Fraction(1, 10**9)
        witness = found.witness[i].numpy()
        assert float(exact) == pytest.approx(float(found.margin[i]), abs=1e-10)
        assert [
            proves_margin_above(matrix, phi[i].numpy(), exact + k * little) for k in (-1, 1)
        ] == [True, False]
        assert [proves_margin_below(matrix, witness, exact + k * little) for k in (-1, 1)] == [
            False,
            True,
        ]


@pytest.mark.parametrize("spread", [0.4, 1.1])
def test_fit_factor_is_the_spread_of_normal_errors(spread: float):
    generator = np.random.default_rng(0)
    views = [spread * np.abs(generator.standard_normal(4000)) for _ in range(12)]
    assert fit_factor(views) == pytest.approx(spread, abs=0.03)
