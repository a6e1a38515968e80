"""Where the host waits for the device inside a loop: what docs/speed.md lists, and nothing else."""

from collections import Counter
from collections.abc import Callable

import pytest
import torch

from tests.devices.conftest import sent
from tests.devices.elsewhere import Waits, elsewhere
from torchgrasp import ContactSpec, load_object, sample_configurations
from torchgrasp.checks import checked
from torchgrasp.geometry.linalg import farthest_points
from torchgrasp.geometry.signed_distance import field_from_surface
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.configuration import Configuration
from torchgrasp.ik.refine import refine
from torchgrasp.plan.problem import ContactProblem
from torchgrasp.plan.solver import Stage, descend, start_state
from torchgrasp.posture_model.em import expectation, expectation_maximisation
from torchgrasp.posture_model.kmeans import start_components
from torchgrasp.posture_model.shard import Shard
from torchgrasp.shape.conditioning import select_points
from torchgrasp.shape.kernel import kernel_by_name
from torchgrasp.shape.surface import extract_surface
from torchgrasp.shape.values import off_surface, on_surface


def waits_of_a_step(waits: Waits, run: Callable[[int], object], few: int, more: int) -> dict[str, float]:
    """Return the waits of one step, by file: those of many steps less those of few, over the steps between."""
    counts = []
    for steps in (few, more):
        waits.places.clear()
        run(steps)
        counts.append(Counter(waits.places))
    by_file: Counter[str] = Counter()
    for place, count in (counts[1] - counts[0]).items():
        by_file[place.split(":")[0]] += count
    return {name: count / (more - few) for name, count in by_file.items()}


@pytest.fixture
def triples(shape, grasps):
    return shape.normalise(grasps.contacts.points)


def test_the_planner_waits_once_a_step(device, shape, triples):
    spec, there = ContactSpec.paper(), sent(shape)
    problem, state = ContactProblem.of(there, spec), start_state(there, sent(triples))

    @checked  # as a public function calls it: within the border nothing is read again
    def run(steps: int) -> object:
        return descend(there, problem, state, Stage(centre=3.0, cones=0.3, steps=steps, settled=0.0))

    assert waits_of_a_step(device, run, 2, 5) == {"optim.py": 1}


def test_refinement_waits_for_the_pairs_of_links_too(device, shape, hand, grasps):
    surface = extract_surface(shape, 24)
    world = CollisionWorld(field_from_surface(surface.vertices, surface.faces, 0.01), 0.0)
    hand, contacts, world = sent(hand), sent(grasps.contacts), sent(world)
    start = sent(Configuration(grasps.joints + 0.1, grasps.obj_from_hand))

    @checked
    def run(steps: int) -> object:
        return refine(hand, start, contacts, world, 0.0, steps)

    found = waits_of_a_step(device, run, 1, 3)
    assert found.pop("optim.py") == 1
    assert 3 <= found.pop("hand/self_collision.py") <= 5  # which pairs are near, of which kinds, which of each kind
    assert found == {}


def test_a_pick_of_the_selection_waits_once(device):
    view = load_object("cylinder").view
    x = elsewhere(view.points[:60].double() * 8)
    noise = torch.full_like(x[:, 0], 0.01)
    seen = on_surface(x, torch.nn.functional.normalize(x, dim=-1), noise, 0.05)
    known = off_surface(torch.zeros_like(x[:1]), -torch.ones_like(x[:1, 0]), 0.1)
    kernel = kernel_by_name("thin_plate", 3.6)

    @checked
    def run(picks: int) -> object:
        return select_points(seen, known, kernel, picks)

    assert waits_of_a_step(device, run, 4, 9) == {"linalg.py": 1}


def test_expectation_waits_only_for_its_factors(device, hand):
    rows = sample_configurations(hand, 400).rows().double()
    shard = Shard(elsewhere((rows - rows.mean(0)) / rows.std(0)))
    start = start_components(shard, 3, 0, 1e-6)
    device.places.clear()
    expectation(shard, start.components)
    assert {place.split(":")[0] for place in device.places} == {"linalg.py"} and device.places.total() == 1

    def run(steps: int) -> object:
        return expectation_maximisation(shard, start, steps, 0.0, 1e-6)

    # the factors, a collapsed component, and the end
    assert waits_of_a_step(device, run, 3, 6) == {"linalg.py": 1, "posture_model/em.py": 2}


def test_farthest_points_and_kinematics_never_wait(device, hand):
    there, joints = sent(hand), elsewhere(torch.zeros(4, hand.dof))
    points = elsewhere(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)))

    @checked
    def run() -> None:
        farthest_points(points, 10)
        there.tree.poses(there.actuated.couple(joints))

    device.places.clear()
    run()
    assert not device.places
