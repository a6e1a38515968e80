"""`torchgrasp grasp --edge`: the file of a drag, the better of two places, and bad options."""

import dataclasses
import json
import math

import pytest
import torch
import trimesh

from tests.make import box
from torchgrasp import load_grasps
from torchgrasp.app.cli import grasp as grasps
from torchgrasp.app.cli.inputs import with_edge
from torchgrasp.cloud import look_at, partial_view, save_cloud
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.plane import Plane
from torchgrasp.planner import drag_of

EDGE = ("--table", "0", "--edge", "0.15", "0", "1", "0")


@pytest.fixture(scope="module")
def low(tmp_path_factory):
    """The file of a view of a low box, whose middle is at x = 0."""
    body = box((0.12, 0.06, 0.01))
    path = tmp_path_factory.mktemp("low") / "low.ply"
    save_cloud(partial_view(body, look_at(-135.0, 40.0, target=body)), path)
    return path


@pytest.fixture(scope="module")
def planned():
    """Keep the first plan at an edge for all tests."""
    kept = []

    def plan(*given, **options):
        if not kept:
            kept.append(plan_edge_grasps(*given, **options))
        return kept[0]

    plan_edge_grasps = grasps.plan_edge_grasps
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(grasps, "plan_edge_grasps", plan)
        yield kept


def run(run_command, low, out, *words):
    quick = ("--starts", "20", "--no-report", "--out", out, *words)
    return run_command("grasp", low, *EDGE, *quick)


def test_a_low_box_is_dragged_to_the_edge_if_more_success_is_predicted_there(
    low, planned, run_command, tmp_path
):
    code, told, err = run(run_command, low, tmp_path, "--json")
    (plan,) = planned
    assert code == 0 and plan.drag is not None
    found = load_grasps(tmp_path / "grasps.safetensors")
    assert drag_of(found) == plan.drag
    assert torch.equal(found.joints, plan.grasps.joints)
    drag = json.loads(told)["drag"]
    x, y, z = drag["displacement_m"]
    # the middle ends some millimetres behind the edge
    assert 0.12 < x < 0.15 and z == 0.0
    assert (
        f"{1e3 * math.hypot(x, y):.0f} mm along (" in err
        and "with the drag: dragged to the edge" in err
    )
    fingers = " and ".join(drag["feet_m"])
    assert f"drag first  {fingers} press" in err and f"{drag['force_n']:.1f} N" in err
    # the estimated surface in the file is where the drag takes the object
    middle = trimesh.load_mesh(tmp_path / "surface.ply").bounds.mean(0)
    assert abs(middle[0] - x) < 0.01 and abs(middle[1] - y) < 0.01


@pytest.mark.parametrize("change", [{"score": -3.0}, {"known": False}])
def test_it_stays_where_it_stands_if_a_grasp_there_is_as_likely_to_hold(
    change, low, planned, run_command, tmp_path, monkeypatch
):
    def worse(*given, **options):
        plan = plan_edge_grasps(*given, **options)
        fields = {
            name: torch.full_like(getattr(plan.grasps, name), x) for name, x in change.items()
        }
        return dataclasses.replace(plan, grasps=dataclasses.replace(plan.grasps, **fields))

    plan_edge_grasps = grasps.plan_edge_grasps
    monkeypatch.setattr(grasps, "plan_edge_grasps", worse)
    code, out, _ = run(run_command, low, tmp_path)
    found = load_grasps(tmp_path / "grasps.safetensors")
    assert code == 0 and "it stays" in out and "drag first" not in out
    assert drag_of(found) is None
    best = found.executable.best
    assert f"success {best.success:.0%} where it stands" in out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--edge", "0.15", "0"], ["X Y OX OY", "2 numbers"]),
        (["--edge", "0.15", "0", "0", "0"], ["direction of length zero"]),
        (["--edge", "0.15", "nan", "1", "0"], ["nan"]),
        ([*EDGE[2:], "--no-table"], ["--no-table"]),
        ([*EDGE[2:], "--up", "0", "1", "0"], ["z is not up", "X Y Z OX OY OZ"]),
        ([*EDGE[2:], "--keep", "-1 -1 0 1 1 1"], ["--keep beside it"]),
        ([*EDGE[2:], "--fingers", "auto"], ["--fingers auto beside it"]),
        ([*EDGE[2:], "--mode", "paper"], ["--mode beside it"]),
        (["--edge", "0", "0", "0.15", "0", "0", "1"], ["along the table"]),
        (["--edge", "150", "0", "1", "0"], ["within 2 m, in metres", "149.9 m from all points"]),
    ],
)
def test_a_bad_edge_is_refused_in_one_sentence(words, said, low, tmp_path, refusal, monkeypatch):
    def work(*given, **options):
        raise AssertionError("the work began")

    monkeypatch.setattr(grasps, "plan_grasps", work)
    error = refusal("grasp", low, *words, "--out", tmp_path / "out")
    assert error.startswith("--edge: ") and all(word in error for word in said), error
    assert not (tmp_path / "out").exists()


def test_four_numbers_are_a_point_on_a_tilted_table():
    tilted = Plane(torch.tensor([0.1, 0.0, 1.0]) / 1.01**0.5, 0.8)
    four = with_edge(tilted, (0.3, 0.2, 1.0, 0.0))
    assert four.edge is not None
    z = (0.8 * 1.01**0.5 - 0.03) / 1.0
    point = torch.tensor([[0.3, 0.2, z]], dtype=torch.float64)
    assert abs(float(four.height(point))) < 1e-6 and abs(float(four.edge.height(point))) < 1e-6
    six = with_edge(tilted, (0.3, 0.2, z, 1.0, 0.0, 0.0))
    assert six.edge is not None and abs(six.edge.offset - four.edge.offset) < 1e-6
    with pytest.raises(BadArgument, match="no-table"):
        with_edge(None, (0.3, 0.2, 1.0, 0.0))
