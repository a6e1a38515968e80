"""A drag in the file of its grasps: the same numbers come back, and other texts are refused."""

import dataclasses
import json

import pytest
import torch

from tests.make import random_motion, real
from torchgrasp import Plane, load_grasps
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.planner import DragPlan, drag_of
from torchgrasp.planner.drag_text import with_drag


def table(edge: bool) -> Plane:
    """A tilted table, whose numbers have no short decimals."""
    plane = Plane.horizontal(1 / 3).moved(random_motion(4))
    return plane.ending(real([0.1, 0.2, 0.3]), real([1.0, 1.0, 0.2])) if edge else plane


def drag(edge: bool = True) -> DragPlan:
    generator = torch.Generator().manual_seed(2)
    numbers = torch.rand(12 + 9 + 3, generator=generator, dtype=torch.float64)
    joints, feet, displacement = numbers.split([12, 9, 3])
    presses = torch.tensor([True, False, True])
    return DragPlan(
        joints=joints,
        obj_from_hand=random_motion(3),
        presses=presses,
        feet=torch.where(presses[:, None], feet.view(3, 3), torch.nan),
        displacement=displacement,
        force=10 / 3,
        table=table(edge),
    )


@pytest.mark.parametrize("edge", [True, False])
def test_a_drag_comes_back_from_the_file_of_its_grasps_bit_by_bit(edge, tmp_path):
    grasps = load_shipped_grasp("jug", "allegro")
    with_drag(grasps, drag(edge)).save(tmp_path / "grasps.safetensors")
    found = load_grasps(tmp_path / "grasps.safetensors")
    assert drag_of(found) == drag(edge)
    # all else is as it was
    meta = {key: text for key, text in found.meta.items() if key != "drag"}
    assert dataclasses.replace(found, meta=meta) == grasps and drag_of(grasps) is None


def test_the_text_names_joints_and_fingers_for_programs_that_read_json():
    grasps = with_drag(load_shipped_grasp("jug", "allegro"), drag())
    told = json.loads(grasps.meta["drag"])
    assert list(told["joints_rad"]) == grasps.meta["joint_names"].split(",")
    assert list(told["feet_m"]) == ["index", "thumb"]


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("joints_rad", {"joint_0": 0.0}, "joint_1"),
        ("joints_rad", None, "joints_rad"),
        ("obj_from_hand_m", [[1.0, 0, 0, 0]] * 4, "rigid"),
        ("obj_from_hand_m", [], "rigid"),
        ("feet_m", {"toe": [0.0, 0.0, 0.0]}, "index, middle, thumb"),
        ("feet_m", {"index": [0.0, 0.0]}, "3 numbers"),
        ("displacement_m", ["x", 0.0, 0.0], "displacement_m"),
        ("force_n", -1.0, "force_n"),
        ("table", {"normal": [0.0, 0.0, 2.0], "offset_m": 0.0}, "unit vector"),
        ("edge", {"normal": [0.0, 0.0, 1.0], "offset_m": 0.0}, "90 degrees"),
    ],
)
def test_a_drag_that_no_planner_wrote_is_refused_by_its_field(name, value, words):
    grasps = with_drag(load_shipped_grasp("jug", "allegro"), drag())
    told = json.loads(grasps.meta["drag"])
    meta = {**grasps.meta, "drag": json.dumps({**told, name: value})}
    with pytest.raises(BadArgument, match=words):
        drag_of(dataclasses.replace(grasps, meta=meta))


def test_a_drag_of_another_hand_is_refused():
    with pytest.raises(BadArgument, match=r"drag: .*4 and 3.*12 joints"):
        with_drag(load_shipped_grasp("jug", "barrett"), drag())


@pytest.mark.parametrize("text", ["", "{", "[]", "3", '{"force_n": NaN}'])
def test_a_text_that_is_no_drag_is_refused(text):
    grasps = load_shipped_grasp("jug", "allegro")
    with pytest.raises(BadArgument, match="drag"):
        drag_of(dataclasses.replace(grasps, meta={**grasps.meta, "drag": text}))
