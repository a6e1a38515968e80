"""A task refuses numbers that no hand can be asked for, and says what it is."""

import math

import numpy as np
import pytest
import torch

from tests.make import directions
from torchgrasp import GraspTask
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.plane import Plane
from torchgrasp.success.task import TaskName, TaskWrenches, loads_of
from torchgrasp.values.specs import TrialSpec


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *[("mass", x) for x in (0.0, -0.1, 11.0, math.nan, math.inf, "heavy", True, None)],
        *[("force", x) for x in (0.0, -1.0, math.nan, math.inf, "strong")],
        *[("lift", x) for x in ("yes", 1.0)],
        *[("closing", x) for x in ("paper", "", None)],
        *[("displaced", x) for x in ("no", None)],
    ],
)
def test_a_wrong_field_is_named(field, value):
    with pytest.raises(BadArgument, match=field):
        GraspTask(**{field: value})


def test_a_lift_in_open_loop_is_refused_and_pulls_are_not():
    with pytest.raises(BadArgument, match="closing"):
        GraspTask(lift=True, closing="open_loop")
    assert not GraspTask(lift=False, closing="open_loop").lifts(Plane.horizontal(0.0))


def test_the_object_is_lifted_where_there_is_a_table_unless_the_task_says_otherwise():
    table = Plane.horizontal(0.0)
    assert GraspTask().lifts(table) and not GraspTask().lifts(None)
    assert GraspTask(lift=True).lifts(None) and not GraspTask(lift=False).lifts(table)


def test_a_table_makes_no_lift_of_a_task_in_open_loop():
    assert not GraspTask(closing="open_loop").lifts(Plane.horizontal(0.0))


def test_a_task_says_what_it_is_and_two_alike_are_equal():
    assert GraspTask().describe() == "task of 0.25 kg"
    assert GraspTask(lift=True, mass=1.0, displaced=True).describe() == "lift of 1 kg, displaced"
    assert GraspTask(lift=False, force=3.5).describe() == "pulls of 0.25 kg with 3.5 N"
    assert (
        GraspTask(0.5) == GraspTask(mass=0.5) != GraspTask(mass=0.6)
        and len({GraspTask(), GraspTask()}) == 1
    )


def test_a_table_is_a_plane():
    with pytest.raises(BadArgument, match="table"):
        GraspTask().lifts(0.0)


def test_a_hand_presses_as_told_grips_in_a_lift_and_presses_a_little_in_pulls():
    assert GraspTask(force=6.0).pressing(True) == GraspTask(force=6.0).pressing(False) == 6.0
    assert (
        GraspTask().pressing(True) == 0.0 and GraspTask().pressing(False) == TrialSpec().strongest
    )


def test_a_load_far_from_its_object_is_refused():
    """A point in millimetres would turn the object with a thousand times the torque."""
    eye = torch.eye(4, dtype=torch.float64)
    center = torch.tensor([0.1, 0.0, 0.05], dtype=torch.float64)
    push = torch.tensor([[0.0, 0.0, -2.5, 0.0, 0.0, 0.0]])
    near = TaskWrenches(push, torch.tensor([0.15, 0.0, 0.0]))
    torque = loads_of(near, 0.4, center, eye, table=True)[0, 3:]
    assert torque.tolist() == pytest.approx([0.0, 0.15 * 2.5, 0.0], abs=1e-6)
    far = TaskWrenches(push, torch.tensor([150.0, 0.0, 0.0]))
    with pytest.raises(BadArgument, match=r"resist\.point: expected one within 2 m, in metres"):
        loads_of(far, 0.4, center, eye, table=True)


@pytest.fixture
def resisted():
    """Tell which forces (n, 3) [N] a grasp of a body of 0.4 kg resists that resists a named task.

    They are the convex hull of the task's loads.
    """
    from scipy.spatial import ConvexHull

    def inside(name: TaskName, forces: np.ndarray) -> np.ndarray:
        eye = torch.eye(4, dtype=torch.float64)
        loads = loads_of(name, 0.4, torch.zeros(3, dtype=torch.float64), eye, table=True)
        assert not loads[:, 3:].any()
        planes = ConvexHull(loads[:, :3].numpy()).equations  # normals, and offsets
        return (forces @ planes[:, :3].T + planes[:, 3] < 1e-9).all(1)

    return inside


def test_who_pours_resists_the_weight_at_any_tilt_up_to_120_degrees_and_no_pull_upward(resisted):
    tilts = directions(2000).numpy()
    tilts = tilts[tilts[:, 2] <= math.cos(math.radians(60))]
    weight = 0.4 * 9.81
    assert resisted("pour", weight * tilts).all()
    assert not resisted("pour", 1.25 * weight * tilts).any()
    assert not resisted("pour", np.array([[0.0, 0.0, weight]])).any()


def test_who_is_pushed_resists_the_weight_with_a_force_of_two_and_a_half_newtons_from_any_side(
    resisted,
):
    weight = np.array([0.0, 0.0, -0.4 * 9.81])
    pushes = 2.5 * directions(2000).numpy()
    assert resisted("push", weight + pushes).all()
    assert not resisted("push", weight + 1.25 * pushes).any()
