"""Neighbours in a trial: pushed, felt, and never taken for the object."""

import dataclasses

import numpy as np
import pytest
import torch
import trimesh

from tests.pinch import QUICK, cylinder, pinch, quick_trial
from torchgrasp import close_hand
from torchgrasp.foundation.errors import BadArgument, MeshError, Status
from torchgrasp.sim import Neighbour
from torchgrasp.values.closing import ClosingOptions

pytestmark = [pytest.mark.sim, pytest.mark.filterwarnings("ignore")]
SIMULATORS = ["sapien", "mujoco"]
ONCE = ClosingOptions(attempts=1)


def box(centre, size=(0.04, 0.04, 0.06)):
    return trimesh.creation.box(size).apply_translation([*centre, size[2] / 2])


def close_beside(simulator, *neighbours, mesh=None, **options):
    pytest.importorskip(simulator)
    hand, grasp = pinch("allegro")
    spec = dataclasses.replace(QUICK, simulator=simulator, **options)
    return close_hand(
        grasp, hand, cylinder() if mesh is None else mesh, spec, neighbours=neighbours
    )


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_a_neighbour_out_of_the_way_changes_nothing_and_stands_still(simulator):
    alone = quick_trial("allegro", simulator)
    beside = close_beside(simulator, Neighbour(box((-0.3, 0.3))))
    assert torch.equal(
        alone.disturbance.neighbour_pose, torch.zeros(len(alone.time), 0, 4, 4, dtype=torch.float64)
    )
    assert beside.held and not beside.disturbance.early[0]
    assert (
        float(
            (beside.disturbance.neighbour_pose[:, 0] - torch.eye(4, dtype=torch.float64))
            .abs()
            .max()
        )
        < 1e-4
    )
    assert torch.isinf(beside.disturbance.first_touch[0]) and beside.disturbance.impulse[0] == 0


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_a_neighbour_in_the_way_of_a_finger_is_pushed_before_the_object_is_touched(simulator):
    """The thumb comes from -y; a light box just outside it is on its way."""
    _, grasp = pinch("allegro")
    tips = pinch("allegro")[0].tip_centres(grasp.pregrasp)[0]
    thumb = (
        grasp.obj_from_hand[0, :3, :3] @ tips[2].double() + grasp.obj_from_hand[0, :3, 3]
    ).tolist()
    in_the_way = box((thumb[0], 0.5 * (thumb[1] - 0.03) - 0.008), (0.03, 0.012, 0.17))
    result = close_beside(simulator, Neighbour(in_the_way, mass=0.02))
    disturbance = result.disturbance
    moved = (
        disturbance.neighbour_pose[-1, 0] @ torch.tensor([*in_the_way.center_mass, 1.0]).double()
    )
    assert bool(disturbance.early[0])
    assert float(disturbance.impulse[0]) > 0 and torch.isfinite(disturbance.first_touch[0])
    assert float((moved[:3] - torch.from_numpy(in_the_way.center_mass)).norm()) > 0.005


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_fingers_that_close_on_a_neighbour_do_not_hold_the_object(simulator, monkeypatch):
    """The object is out of reach; a body like it stands where the hand closes."""
    monkeypatch.setattr(
        "torchgrasp.evaluation.lift.check_contacts", lambda *_, **__: None
    )  # else it is refused
    result = close_beside(
        simulator, Neighbour(cylinder()), mesh=cylinder((-0.25, 0.0)), options=ONCE
    )
    assert not result.held and result.status is Status.NO_CONTACT
    assert float(result.forces.max()) == 0.0 and result.contact_order == ()
    assert float(result.disturbance.impulse[0]) > 0.01


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_a_start_inside_a_neighbour_is_refused_but_neighbours_may_touch_the_table_and_each_other(
    simulator,
):
    _, grasp = pinch("allegro")
    start = grasp.obj_from_hand[0, :3, 3] - 0.1 * grasp.approach[0]
    inside = trimesh.creation.box([0.1, 0.1, 0.1])
    inside.apply_translation(start.numpy())
    assert close_beside(simulator, Neighbour(inside)).status is Status.START_OVERLAP
    overlapping = [Neighbour(box((-0.3, 0.3))), Neighbour(box((-0.3, 0.305)))]
    assert close_beside(simulator, *overlapping).start_overlap == 0.0


def test_neighbours_weigh_what_they_are_given_and_are_checked():
    pytest.importorskip("sapien")
    from torchgrasp.evaluation import GraspTrial, Truth
    from torchgrasp.evaluation.trial import TrialDriver
    from torchgrasp.values.specs import TrialSpec

    hand, grasp = pinch("allegro")
    around = [Neighbour(box((0.3, 0.3))), Neighbour(box((-0.3, 0.3)), mass=0.5)]
    driver = TrialDriver(
        GraspTrial(hand, grasp, Truth(cylinder(), neighbours=around)), TrialSpec(density=300.0)
    )
    masses = [body.mass for body in driver.scene_spec.neighbours]
    assert masses == [pytest.approx(300 * 0.04 * 0.04 * 0.06), 0.5]
    scene = driver.open().scene
    assert [float(body.mass) for body in scene.neighbours] == pytest.approx(masses)
    assert np.allclose(scene.neighbour_poses(), np.eye(4), atol=1e-6)
    opened = trimesh.Trimesh(box((0, 0)).vertices, box((0, 0)).faces[:-1])
    with pytest.raises(MeshError, match="open surface"):
        close_hand(grasp, hand, cylinder(), neighbours=[Neighbour(opened)])


def test_a_mass_that_is_not_positive_is_refused():
    with pytest.raises(BadArgument, match="mass"):
        Neighbour(box((-0.3, 0.3)), mass=-1.0)
