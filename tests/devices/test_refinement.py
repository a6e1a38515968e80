"""What refines, checks and closes grasps on another device: fields of distance, errors, both solvers, a vessel."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from tests.devices.conftest import same, sent
from tests.make import cup_view
from tests.pinch import QUICK, cylinder, pinch
from torchgrasp import ContactSpec, certify, fit_shape
from torchgrasp.evaluation.lift import close_hand
from torchgrasp.geometry.signed_distance import field_from_surface
from torchgrasp.ik import CollisionWorld, GraspProblem, PostureLibrary, nearest_postures, solve_joint
from torchgrasp.ik.attempts import solve_contact_first
from torchgrasp.ik.candidates import measure_errors
from torchgrasp.ik.configuration import Configuration
from torchgrasp.shape import extract_surface

SPEC = ContactSpec(table=0.0)
TURNED = torch.tensor([[0.0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]], dtype=torch.float64)


def here(value: Any) -> Any:
    """Return a value where it is."""
    return value


def test_fields_are_asked_where_they_are(device, shape, grasps):
    def ask(to: Callable[[Any], Any]) -> tuple[torch.Tensor, ...]:
        surface = extract_surface(to(shape), 24)
        field = field_from_surface(surface.vertices, surface.faces, 0.01)
        points = to(grasps.contacts.points)
        return (*field.query(points), field.nearest_node(points))

    same(ask(sent), ask(here))


def test_grasps_are_solved_and_checked_where_their_contacts_are(device, hand, shape, grasps):
    library = PostureLibrary.of(hand, 300)

    def solve(to: Callable[[Any], Any]) -> list[Any]:
        there, contacts, its_hand = to(shape), to(grasps.contacts), to(hand)
        surface = extract_surface(there, 24)
        world = CollisionWorld(field_from_surface(surface.vertices, surface.faces, 0.01), 0.0)
        problem = GraspProblem(its_hand, contacts, certify(contacts, SPEC), world, surface.vertices.mean(0))
        seeds = nearest_postures(to(library), contacts, world, 2)
        configuration = Configuration(to(grasps.joints), to(grasps.obj_from_hand))
        return [
            seeds,
            measure_errors(its_hand, configuration, contacts, world),
            solve_contact_first(problem, seeds),
            solve_joint(problem, seeds, there, SPEC),
        ]

    same(solve(sent), solve(here))


def test_a_shape_is_turned_where_it_is(device, shape):
    same(sent(shape).moved(sent(TURNED)), shape.moved(TURNED))


def test_both_walls_of_a_vessel_are_where_the_cloud_is(device):
    def fit(to: Callable[[Any], Any]) -> list[Any]:
        vessel = fit_shape(to(cup_view(0.004)), table=0.0)
        assert len(vessel.walls) == 2
        x = to(cup_view(0.004).points[:20].double())
        return [vessel, vessel.predict(x), vessel.jet(vessel.normalise(x)), vessel.moved(to(TURNED))]

    same(fit(sent), fit(here))


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
def test_a_closing_is_the_same_wherever_hand_and_grasp_are(device):
    pytest.importorskip("sapien")
    hand, grasp = pinch("allegro")
    there, near = (close_hand(to(grasp), to(hand), cylinder(), QUICK) for to in (sent, here))
    assert there.held and near.held
    assert np.array_equal(there.forces, near.forces) and np.array_equal(there.object_pose, near.object_pose)
