"""scripts/bench.py headline: README's table is of plans that the present code makes; counts of lifts
by hand; the hidden side against a sphere.
"""

import math

import pytest
import torch
from benchmarks.common import Row
from benchmarks.headline.lifts import row_of
from benchmarks.headline.page import (
    BEGIN,
    END,
    README,
    golden_plans,
    read_plans,
    readme_table,
    replace_table,
)
from benchmarks.headline.shapes import judge_hidden, measure_floor
from benchmarks.headline.touched import Touch, distance_from, judge_contacts

from torchgrasp.evaluation import ProtocolResult, ViewScore
from torchgrasp.foundation.errors import Status
from torchgrasp.geometry.linalg import unit

CLOSE = 1e-6  # of joints [rad], contacts [m] and log-odds: processors round otherwise


def test_the_plans_of_the_table_in_readme_are_those_of_the_present_code():
    """Otherwise the table is of another planner: run scripts/bench.py headline --publish again."""
    told = read_plans()
    found = golden_plans()
    assert found.keys() == told.keys()
    for name, plan in found.items():
        assert plan["statuses"] == told[name]["statuses"], name
        for what in ("joints", "contacts", "log_odds"):
            one, other = (torch.tensor(x[name][what]).double() for x in (found, told))
            assert torch.allclose(one, other, rtol=0.0, atol=CLOSE), (name, what)


def scores() -> list[ViewScore]:
    def tried(name: str, family: str, passed: bool, tries: int) -> ViewScore:
        status = Status.OK if passed else Status.DROPPED
        attempt = ProtocolResult(0, 0, passed, status, tries=tries)
        return ViewScore(name, "view0", 5, 1.0, (attempt,), family=family)

    return [
        tried("mug", "cup", True, 1),
        tried("cup", "cup", True, 3),
        tried("pan", "pan", False, 3),
        ViewScore("pen", "view0", 0, 1.0, refusal=Status.OUT_OF_REACH, family="pen"),
    ]


def test_a_row_counts_first_grasps_further_ones_and_refusals():
    row = row_of("allegro", "in place", "sapien", scores(), 0.5)
    assert row.numbers["risen"].value == 0.5 and row.numbers["first"].value == 0.25
    assert row.numbers["risen"].units == 3 and row.numbers["refused"] == 1
    assert row.numbers["lost"] == {"pan": ["DROPPED"], "pen": ["OUT_OF_REACH"]}
    assert not row.met  # the first grasps miss their own bar


def test_the_table_of_readme_stands_between_its_marks():
    rows = [row_of("leap", "in place", "mujoco", scores(), 0.5), Row("other", "-", "-")]
    lines = readme_table(rows, "Commit 1234abcd; a processor")
    assert "commit 1234abcd " in lines[0] and len(lines) == 5
    assert lines[-1].startswith("| LEAP: in place, in MuJoCo | 50.0 %")
    assert lines[-1].endswith("| 1 of 4 |")
    text = replace_table(f"before\n{BEGIN}\nold\n{END}\nafter\n", lines)
    assert text == "\n".join(["before", BEGIN, "", *lines, "", END, "after", ""])
    assert replace_table(text, lines) == text
    assert README.read_text("utf-8").count(BEGIN) == 1
    with pytest.raises(SystemExit, match=r"README\.md has no lines"):
        replace_table("nothing", lines)


def test_the_hidden_side_is_what_the_other_camera_saw_alone():
    directions = unit(
        torch.randn(4000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    )
    ball = 0.035 * directions + torch.tensor([0.0, 0.0, 0.048])
    front = ball[ball[:, 0] > 0.005]
    found = judge_hidden(front[:800], ball)
    wrong = judge_hidden(front[:800], ball + torch.tensor([-0.02, 0.0, 0.0]))
    assert found["median"] < 3.0 < 6.0 < wrong["median"]
    assert 0.0 <= found["within_1"] <= found["within_2"] <= found["within_3"] <= 1.0
    assert math.isnan(judge_hidden(front[:3], ball)["median"])  # too few points: refused
    far = torch.tensor([[0.5, 0.0, 0.048]], dtype=torch.float64)
    away = judge_hidden(front[:800], torch.cat([front[:800], far]))
    assert away["median"] == pytest.approx(465.0, abs=10.0)
    assert away["within_3"] == 0.0


def test_the_floor_of_real_views_is_the_distance_of_the_cameras_where_both_see() -> None:
    generator = torch.Generator().manual_seed(0)
    flat = 0.05 * torch.rand(600, 3, generator=generator, dtype=torch.float64)
    flat[:, 2] = 0.0
    above = flat[:300] + torch.tensor([0.0, 0.0, 0.002])
    far = flat[:300] + torch.tensor([0.0, 0.0, 0.1])  # the view did not see it
    assert measure_floor(flat, torch.cat([above, far])) == pytest.approx(2.0, abs=0.01)
    assert math.isnan(measure_floor(flat, far))


def test_contacts_on_real_views_are_near_what_was_measured_or_told() -> None:
    flat = torch.zeros(4, 3, dtype=torch.float64)
    flat[:, 0] = torch.tensor([0.0, 0.1, 0.2, 0.3])
    height = torch.tensor([0.004, 0.006, 0.02])
    above = flat[:3].clone()
    above[:, 2] = height
    away = distance_from(flat, above)
    torch.testing.assert_close(away, height.double())
    # the first is near, the second is told by its deviation, the third is not
    row = judge_contacts("", [Touch(away, torch.tensor([0.0, 0.003, 0.009]).double(), 0.9)], 1)
    assert row.measured.startswith("33% of 3; 1 of the other 2 are told") and not row.met
    near = [Touch(away[:1], away[:1], 0.9)] * 9
    assert not judge_contacts("", [*near, Touch(away[2:], away[:1], 0.9)], 0).met
    told = judge_contacts("", [*near, Touch(away[2:], away[2:], 0.9)], 0)
    assert told.met and told.measured.startswith("90% of 10; 1 of the other 1 ")
