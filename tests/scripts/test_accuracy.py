"""The measure of a shape against balls and cylinders, whose errors are known in closed form."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from benchmarks.ground_truth import sample_mesh
from benchmarks.shape import weaker_inputs
from benchmarks.shape.accuracy import (
    find_edges,
    format_table,
    mean_row,
    measure_accuracy,
    measure_shape,
)
from benchmarks.shape.weaker_inputs import bench_weaker
from benchmarks.shape.worst_views import bench_worst
from PIL import Image

from torchgrasp.shape.fit import condition
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.values import Normalisation, Observations
from torchgrasp.values import PointCloud

RADIUS = 0.04


def _ball(radius: float = RADIUS) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=4, radius=radius)


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    n = torch.randn(3000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    n = n / torch.linalg.vector_norm(n, dim=-1, keepdim=True)
    return PointCloud(RADIUS * n, n)


@pytest.fixture(scope="module")
def shape(cloud: PointCloud) -> ShapeGP:
    """A ball observed everywhere: on it with normals, and by exact distances inside and around."""
    assert cloud.normals is not None
    n = cloud.normals[:120]
    x = torch.cat([n, torch.zeros(1, 3, dtype=torch.float64), 1.2 * n[:40]])
    distance = torch.cat([torch.zeros(120), torch.tensor([-1.0]), torch.full((40,), 0.2)]).double()
    oriented = torch.arange(len(x)) < 120
    noise = torch.full_like(distance, 0.01)
    observations = Observations(x, distance, torch.cat([n, torch.zeros_like(x[120:])]), oriented, noise, noise)
    return condition(observations, Normalisation(torch.zeros(3, dtype=torch.float64), RADIUS), cloud)


def test_a_whole_ball_is_all_seen_and_nearly_exact(shape: ShapeGP, cloud: PointCloud):
    row = measure_shape(shape, _ball(), cloud)
    assert row["seen_median_mm"] < 0.3 and row["seen_p90_mm"] < 1.0 and row["seen_normal_deg"] < 4
    assert row["seen_within_3"] == 1.0
    assert math.isnan(row["hidden_median_mm"]) and math.isnan(row["hidden_within_2"])
    assert row["sure_share"] > 0.9 and row["sure_median_mm"] < 0.3 and row["sure_normal_deg"] < 4


def test_a_larger_true_ball_is_off_by_the_difference_of_the_radii(shape: ShapeGP, cloud: PointCloud):
    row = measure_shape(shape, _ball(RADIUS + 0.003), cloud)
    assert row["seen_median_mm"] == pytest.approx(3.0, abs=0.2)
    assert row["sure_median_mm"] == pytest.approx(3.0, abs=0.2) and row["chamfer_mm"] == pytest.approx(3.0, abs=0.2)
    assert row["seen_normal_deg"] < 4


def test_a_wide_band_covers_and_a_narrow_one_does_not(shape: ShapeGP, cloud: PointCloud):
    mesh = _ball(RADIUS + 0.002)
    wide, narrow = (measure_shape(dataclasses.replace(shape, std_factor=f), mesh, cloud) for f in (100.0, 0.01))
    assert wide["seen_within_1"] == 1.0 and narrow["seen_within_3"] == 0.0
    assert wide["seen_raw_2"] == pytest.approx(narrow["seen_raw_2"], abs=1e-12)


def test_what_the_cloud_never_saw_is_hidden(shape: ShapeGP):
    seen = PointCloud(_sphere_part())
    row = measure_shape(shape, _ball(), seen)
    assert row["hidden_median_mm"] < 0.3 and row["seen_median_mm"] < 0.3 and row["chamfer_mm"] < 0.3


def _sphere_part() -> torch.Tensor:
    n = torch.randn(900, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    n = n / torch.linalg.vector_norm(n, dim=-1, keepdim=True)
    return RADIUS * n[n[:, 0] > 0]


@pytest.fixture
def tin(tmp_path: Path) -> Path:
    """A folder of one object: a standing cylinder, seen from one side."""
    (tmp_path / "tin").mkdir()
    mesh = trimesh.creation.cylinder(radius=0.06, height=0.24, sections=64)
    mesh.apply_translation([0, 0, 0.12])
    mesh.export(tmp_path / "tin" / "mesh.ply")
    rng = np.random.default_rng(0)
    angle, height = (rng.random(700) - 0.5) * 2.9, 0.24 * rng.random(700)
    seen = np.stack([0.06 * np.cos(angle), 0.06 * np.sin(angle), height], -1)
    trimesh.PointCloud(seen).export(tmp_path / "tin" / "view0_noisy.ply")
    pose = np.eye(4)
    pose[:3, 3] = [0.9, 0.0, 0.3]
    entry = {"suggested_scale": 0.5, "group": "solid", "views": {"view0": {"T_object_camera": pose.tolist()}}}
    (tmp_path / "manifest.json").write_text(json.dumps({"objects": {"tin": entry}}))
    return tmp_path


def test_a_folder_of_objects_becomes_rows_and_a_table(tin: Path):
    rows = measure_accuracy(tin)
    assert [(r["object"], r["view"]) for r in rows] == [("tin", "view0")]
    assert rows[0]["seen_median_mm"] < 1 and rows[0]["hidden_median_mm"] < 6
    text = format_table(rows)
    assert len(text.splitlines()) == 5 and "tin" in text and "2 std_m" in text


def test_errors_of_the_camera_stay_errors_of_the_surface(tin: Path, monkeypatch):
    monkeypatch.setattr(weaker_inputs, "FACTORS", ("none", "camera"))
    none, camera = bench_weaker(tin, (), 0)
    assert none.numbers["hidden_median_mm"]["change"][0] == 0
    change = camera.numbers["hidden_median_mm"]["change"][0]
    expected = camera.numbers["hidden_median_mm"]["mean"] - none.numbers["hidden_median_mm"]["mean"]
    assert change == pytest.approx(expected) and abs(change) > 0.3


def test_the_worst_views_are_drawn_on_a_page_of_their_group(tin: Path):
    (row,) = bench_worst(tin, (), tin / "out")
    assert "tin view0" in row.measured
    with Image.open(tin / "out" / "worst_solid.jpg") as page:
        colors = page.convert("RGB").getcolors(1 << 24)
    assert page.width == 5 * 270 and len(colors) > 1000


def test_a_mean_leaves_out_what_was_not_measured():
    assert mean_row([{"a": 1.0, "b": math.nan, "view": "x"}, {"a": 3.0, "b": 5.0, "view": "y"}]) == {"a": 2.0, "b": 5.0}


def test_edges_are_where_faces_meet_and_the_other_side_of_a_wall_is_none():
    points, normals = sample_mesh(trimesh.creation.box([0.1, 0.1, 0.004]), 3000, np.random.default_rng(0))
    edge = find_edges(points, normals)
    inside = points[:, :2].abs().amax(1) < 0.041
    assert not bool(edge[inside].any())
    assert float(edge[points[:, :2].abs().amax(1) > 0.046].double().mean()) > 0.95
