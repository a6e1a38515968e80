"""scripts/bench.py and scripts/train.py: each bench runs on its smallest case; measures agree with
closed forms.
"""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from bench import SUBJECTS
from benchmarks import common
from benchmarks.common import Options, Row, benches_of, keep_rows, measure, write_section
from benchmarks.ground_truth import read_views, sample_hidden
from benchmarks.headline.lifts import are_kept
from benchmarks.headline.shapes import measure_shape
from benchmarks.plan import beside, timed
from train.bands import fit_factor

from torchgrasp import PointCloud, fit_shape
from torchgrasp.evaluation import PROTOCOLS
from torchgrasp.geometry.linalg import unit

RUNS = ("gpu/launches", "scene/rooms")
SIMULATED = ("headline/region",)
SHORT = {"hold_time": 0.1, "control_rate": 50.0}
"""Trials whose verdicts do not matter."""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "name", [*RUNS, *(pytest.param(x, marks=pytest.mark.sim) for x in SIMULATED)]
)
def test_bench_writes_its_rows(name, tin, tmp_path, monkeypatch, few_postures, kept):
    monkeypatch.setitem(PROTOCOLS, "household", PROTOCOLS["household"].with_trial(**SHORT))
    subject, short = name.split("/")
    options = Options(
        (short,),
        (tin,),
        ("tin",),
        hands=("barrett",),
        starts=4,
        batches=(1,),
        scale=2e-4,
        workers=0,
        out=tmp_path / "out",
    )
    rows = measure(subject, options)
    assert len(rows) > 0
    written = json.loads((tmp_path / "out" / "rows" / f"{subject}-{short}.json").read_text())
    assert [row["what"] for row in written["rows"]] == [row.what for row in rows]
    table = (tmp_path / "out" / f"{subject}-{short}.md").read_text()
    assert "Commit " in table and table.count("\n| ") == len(rows) + 2


CITED = re.compile(r"`(?:scripts/)?(?:bench\.py )?(\w+) --only ((?:[a-z][\w-]*[ `])+)")
HELD = re.compile(r"[Cc]ommits? [0-9a-f]{7}")


def test_benches_in_the_documentation_exist_or_have_a_commit():
    root = Path(__file__).parents[2]
    kept = 0
    for path in (*(root / "docs").rglob("*.md"), *root.glob("*/README.md")):
        text = path.read_text()
        for cited in CITED.finditer(text):
            subject, names = cited.groups()
            known = benches_of(subject) if subject in SUBJECTS else {}
            if set(names.strip("`").split()) <= set(known):
                kept += 1
                continue
            # "Commit 5382ed30 has `...`", or "`...` at commit 5382ed30"
            around = text[max(cited.start() - 40, 0) : cited.end() + 80]
            assert HELD.search(around), (path, cited[0])
    assert kept > 10


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
    assert set(times) == {"shape", "predict", "deviation", "surface", "field"}
    assert min(times.values()) > 0


def test_a_section_of_a_page_is_replaced(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# Page\n\n## Beside a\n\noutdated\n\n## Other\n\ntext\n")
    for measured in ("2", "3"):
        write_section(page, "Beside a", [Row("what", "-", measured)], Options())
    text = page.read_text()
    assert text.startswith("# Page\n\n## Other\n\ntext\n\n## Beside a\n")
    assert text.count("## Beside a") == 1 and text.endswith("| what | - | 3 | - |\n")
    assert "Commit " in text and "outdated" not in text


def ball(radius: float, n: int) -> torch.Tensor:
    return radius * unit(
        torch.randn(n, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    )


def test_the_hidden_side_of_a_larger_ball_is_off_by_the_difference_of_the_radii():
    points = ball(0.04, 2000)
    shape = fit_shape(PointCloud(points, unit(points)))
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.043)
    front = PointCloud(points[points[:, 0] > 0])
    row = measure_shape(shape, mesh, front)
    assert row["median"] == pytest.approx(3.0, abs=0.2) and row["p90"] < 3.5
    hidden = sample_hidden(mesh, front, 3000)
    assert hidden[:, 0].max() < 0.006 and hidden[:, 0].min() < -0.042
    whole = measure_shape(shape, trimesh.creation.icosphere(4, 0.04), PointCloud(points))
    assert all(math.isnan(value) for value in whole.values())


@pytest.mark.parametrize("spread", [0.4, 1.1])
def test_fit_factor_is_the_spread_of_normal_errors(spread: float):
    generator = np.random.default_rng(0)
    views = [spread * np.abs(generator.standard_normal(4000)) for _ in range(12)]
    assert fit_factor(views) == pytest.approx(spread, abs=0.03)


def test_grasps_are_kept_only_if_every_object_has_some(tmp_path):
    assert not are_kept(tmp_path, ["cup", "pan"])
    (tmp_path / "cup").mkdir()
    (tmp_path / "cup" / "view0.safetensors").touch()
    # a run that was cut off
    assert not are_kept(tmp_path, ["cup", "pan"])
    assert are_kept(tmp_path, ["cup"])
