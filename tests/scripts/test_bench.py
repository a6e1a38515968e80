"""scripts/bench.py and scripts/train.py: each bench runs on its smallest case; measures agree with
closed forms.
"""

import dataclasses
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
from benchmarks.close.conditions import CONDITIONS, draw_solid
from benchmarks.close.holding import EDGES, least_grip
from benchmarks.close.misplaced import _misplace, median_over
from benchmarks.close.statics import can_hold, true_contacts
from benchmarks.common import Options, benches_of, measure
from benchmarks.gpu.compare import bench_kernel
from benchmarks.gpu.kernels import kernels
from benchmarks.ground_truth import nearest_on_mesh, sample_mesh
from benchmarks.load.campaign import Rates
from benchmarks.plan.exact_lp import (
    exact_margin,
    proves_margin_above,
    proves_margin_below,
    wrench_matrix,
)
from benchmarks.shape.accuracy import find_edges, mean_row, measure_shape
from benchmarks.shape.walls import measure_walls
from scipy.spatial.transform import Rotation
from train.bands import fit_factor
from train.bodies import COUNTS, author_body

from tests.make import cup, cup_view
from tests.pinch import cylinder, pinch
from torchgrasp import Contacts, ContactSpec, PointCloud, certify, fit_shape, load_object
from torchgrasp.contacts.form_closure import solve_closure_lp, wrenches
from torchgrasp.geometry.frames import inverse
from torchgrasp.geometry.linalg import unit

RUNS = (
    "gpu/launches",
    "hand/collision",
    "load/scheduler",
    "load/starts",
    "load/waiting",
    "plan/truth",
    "scene/plane",
    "scene/rooms",
)
SIMULATED = ("close/perturb", "load/campaign")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "name", [*RUNS, *(pytest.param(x, marks=pytest.mark.sim) for x in SIMULATED)]
)
def test_bench_writes_its_rows(name, tin, tmp_path):
    subject, short = name.split("/")
    options = Options(
        (short,),
        (tin,),
        hands=("barrett",),
        conditions=("none",),
        starts=30,
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


def test_a_fleet_is_as_fast_as_its_slower_part():
    """A core plans 3 s and tries 20 grasps of half a second; a core beside a GPU only tries."""
    rates = Rates(3.0, 0.5, 20.0, *[0.0] * (len(Rates._fields) - 3))
    assert rates.views_per_hour(13) == pytest.approx(3600) and rates.views_per_hour(
        10, 1, 100.0
    ) == pytest.approx(3600)
    assert (
        rates.views_per_hour(160, 1, 2.0)
        == pytest.approx(7200)
        == rates.views_per_hour(160, 2, 1.0)
    )


def test_kernels_of_the_gpu_bench_agree_with_themselves():
    quick = [
        kernel
        for kernel in kernels(True)
        if kernel.name in ("condition", "certify", "Hand.jacobian", "EM step")
    ]
    assert len(quick) == 4
    for kernel in quick:
        small = dataclasses.replace(kernel, sizes=kernel.sizes[:1])
        assert bench_kernel(small, torch.device("cpu"), (1,)).met, kernel.name


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


@pytest.mark.parametrize("condition", ["in place", "20 mm", "10 degrees", "afloat, 10 mm"])
def test_misplace_moves_the_object_by_the_amount_of_the_condition(condition):
    wrong = CONDITIONS[condition]
    mesh = cylinder((0.02, 0.01))
    (_, grasp) = pinch("allegro")
    planned = grasp.obj_from_hand[0].double()
    centre = torch.tensor([*mesh.center_mass, 1.0])
    for seed in range(5):
        moved = planned @ inverse(planned @ _misplace(wrong, grasp, mesh, seed))
        shift = moved @ centre - centre
        turned = Rotation.from_matrix(moved[:3, :3].numpy()).as_rotvec()
        assert float(shift.norm()) == pytest.approx(wrong.distance, abs=1e-9)
        assert math.hypot(*turned) == pytest.approx(wrong.angle, abs=1e-7)
        assert wrong.afloat or abs(float(shift[2])) < 1e-9


def test_draw_solid_is_closed_and_near_the_mean_surface():
    shape = fit_shape(load_object("jug").view, table=0.0)
    one = draw_solid(shape, 0)
    other = draw_solid(shape, 1)
    assert one.is_watertight and not np.array_equal(one.vertices, other.vertices)


def test_median_over_resamples_families():
    assert median_over([("tin", 1.0), ("tin", 3.0), ("cup", 2.0), ("jug", math.nan)]) == (
        2.0,
        2.0,
        2.0,
    )


PINCH = torch.tensor(
    [[0.03, 0.0, 0.0], [-0.03, 0.0, 0.0], [0.0, 0.03, 0.0], [0.0, -0.03, 0.0]]
).double()
UP = torch.tensor([0.0, 0.0, 2.0, 0.0, 0.0, 0.0]).double()


@pytest.mark.parametrize("friction", [0.3, 0.8])
def test_least_grip_of_opposing_fingers_is_the_weight_over_the_friction(friction):
    normals = PINCH / 0.03
    forces = least_grip(PINCH, normals, UP, friction)
    assert forces is not None and torch.allclose(forces.sum(0), UP[:3], atol=1e-8)
    total = float(-(forces * normals).sum())
    assert (
        2.0 / friction
        <= total * 1.0000001
        <= 2.0 / friction / math.cos(math.pi / EDGES) * 1.0000001
    )


def test_least_grip_is_none_for_fingers_on_one_side_and_for_weak_drives():
    normals = torch.tensor([1.0, 0.0, 0.0]).double().expand(4, 3)
    assert least_grip(PINCH, normals, UP, 0.8) is None
    outward = PINCH / 0.03
    for effort, held in ((0.7, True), (0.6, False)):  # each finger has to push with 0.625 N
        torques = outward[:, None] / effort * torch.eye(4).double()[:, :, None]
        assert (least_grip(PINCH, outward, UP, 0.8, torques) is not None) is held


def test_two_fingers_hold_a_load_beside_their_line_by_the_torque_of_their_patches_alone():
    points = PINCH[:2]
    normals = PINCH[:2] / 0.03
    load = UP + torch.tensor([0.0, 0.0, 0.0, 0.016, 0.0, 0.0])
    assert least_grip(points, normals, load, 0.5) is None
    forces = least_grip(points, normals, load, 0.5, patch=0.005)
    assert forces is not None
    assert float(-(forces * normals).sum()) == pytest.approx(0.016 / (0.5 * 0.005))


def test_contacts_on_the_true_surface_hold_a_cylinder_unless_it_is_heavy_on_one_side():
    hand = "barrett"
    (_, grasp) = pinch("barrett")
    points, normals = true_contacts(grasp, cylinder())
    np.testing.assert_allclose(points, grasp.contacts.points[0], atol=2e-3)  # a polygon of 32 sides
    assert float((torch.from_numpy(normals) * grasp.contacts.normals[0]).sum(-1).min()) > 0.99
    assert can_hold(grasp, cylinder(), hand) == (True, True)
    lopsided = cylinder()
    lopsided.center_mass = [2.0, 0.0, 0.1]
    assert can_hold(grasp, lopsided, hand) == (False, False)


@pytest.mark.parametrize("spread", [0.4, 1.1])
def test_fit_factor_is_the_spread_of_normal_errors(spread: float):
    generator = np.random.default_rng(0)
    views = [spread * np.abs(generator.standard_normal(4000)) for _ in range(12)]
    assert fit_factor(views) == pytest.approx(spread, abs=0.03)


def test_authored_bodies_are_closed_and_repeatable():
    bodies = {kind: author_body(kind, 0) for kind in COUNTS}
    assert all(body.is_volume for body in bodies.values())
    np.testing.assert_array_equal(author_body("bowl", 0).vertices, bodies["bowl"].vertices)
