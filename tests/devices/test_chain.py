"""The whole chain on another device: plans, reasons, scenes, fields, solvers, vessels, and the
files that it writes.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from tests.devices.conftest import at_home, same, sent
from tests.devices.elsewhere import DEVICE
from tests.make import cup_view, load_hand, see
from tests.pinch import QUICK, cylinder, pinch
from tests.planner.test_many import share_found
from torchgrasp import (
    ContactSpec,
    GraspTask,
    PointCloud,
    certify,
    explain_empty,
    explain_success,
    fit_shape,
    load_object,
    load_scene,
    plan_contacts,
    plan_grasps,
    plan_scene,
    stream_grasps,
)
from torchgrasp.cloud import diagnose_cloud, estimate_normals, format_report, save_cloud
from torchgrasp.evaluation import find_protocol
from torchgrasp.evaluation.lift import close_hand
from torchgrasp.evaluation.protocols import draw_object_poses
from torchgrasp.export import (
    format_graspgen,
    format_grasps,
    format_isaac,
    format_keyframes,
    format_moveit,
    format_trajectories,
    grasps_from_joints,
    largest_std,
    save_dexgraspbench,
    save_surface,
)
from torchgrasp.geometry.signed_distance import field_from_surface
from torchgrasp.ik import (
    CollisionWorld,
    GraspProblem,
    Obstacles,
    PostureLibrary,
    nearest_postures,
    solve_joint,
)
from torchgrasp.ik.attempts import solve_contact_first
from torchgrasp.ik.candidates import measure_errors
from torchgrasp.ik.configuration import Configuration
from torchgrasp.ik.motion import collision_probability, lift_clearance
from torchgrasp.planner.objects import take_target
from torchgrasp.planner.rows import spread_rows
from torchgrasp.scene import estimate_occupancy
from torchgrasp.scene.removal import take_away
from torchgrasp.shape import extract_surface
from torchgrasp.shape.completion.complete import complete_cloud
from torchgrasp.shape.completion.silhouette import silhouettes
from torchgrasp.testing import random_joints

pytestmark = pytest.mark.usefixtures("kept")  # the shapes of the CPU alone
SPEC = ContactSpec(table=0.0)
CPU = torch.device("cpu")
VIEW = load_object("cylinder").view
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)

PLANS = {
    "task and promise": lambda cloud, hand: plan_grasps(
        cloud, hand, SPEC, 2, task=GraspTask(0.1), promise=0.8
    ),
    "stream": lambda cloud, hand: list(stream_grasps(cloud, hand, SPEC, 2)),
    "any fingers": lambda cloud, hand: plan_grasps(cloud, hand, SPEC, 2, fingers="auto"),
    "four fingers": lambda cloud, hand: plan_grasps(cloud, load_hand("allegro", 4), SPEC, 2),
    "contacts first": lambda cloud, hand: plan_grasps(
        cloud, hand, SPEC, 2, mode="contact_first", ranking="variance"
    ),
    "paper": lambda cloud, hand: plan_grasps(cloud, hand, ContactSpec.paper(), 2, mode="paper"),
}
TEXTS = {
    "grasps": lambda hand, grasps: format_grasps(hand, grasps),
    "keyframes": lambda hand, grasps: format_keyframes(hand, grasps),
    "moveit": lambda hand, grasps: format_moveit(hand, grasps),
    "isaac": lambda hand, grasps: format_isaac(hand, grasps),
    "trajectories": lambda hand, grasps: format_trajectories(hand, grasps),
    "graspgen": lambda hand, grasps: format_graspgen(grasps, "object.obj"),
}


@pytest.mark.promise("F8")
@pytest.mark.parametrize("name", PLANS)
def test_grasps_of_every_kind_are_where_the_cloud_is(device, hand, name, few_postures):
    same(PLANS[name](sent(VIEW), hand), at_home(lambda: PLANS[name](VIEW, hand)))


def test_clouds_planned_together_have_the_grasps_of_each_alone(device, hand, few_postures):
    clouds = [VIEW, PointCloud(1e-4 * VIEW.points, None, VIEW.viewpoint), cup_view(0.004)]
    task = GraspTask(0.1)
    alone = at_home(lambda: plan_grasps(clouds, hand, SPEC, 2, task=task))
    together = plan_grasps(sent(clouds), hand, SPEC, 2, task=task)
    assert "refused" in together[1].meta and all(
        grasps.joints.device == DEVICE for grasps in together
    )
    for there, here in zip(together[::2], alone[::2], strict=True):
        assert there.meta == here.meta
        assert share_found(here, there.to("cpu")) > 0.9  # rounding may move a few


def test_workers_estimate_shapes_for_plans_where_the_clouds_are(
    device, hand, monkeypatch, few_postures
):
    """The workers are played by this process, which alone knows the pretended device."""
    serial = lambda function, tasks, workers, limit: (function(*task) for task in tasks)  # noqa: E731
    monkeypatch.setattr("torchgrasp.planner.many.run_tasks", serial)
    expected = at_home(lambda: plan_grasps([VIEW], hand, SPEC, 2))
    same(plan_grasps([sent(VIEW)], hand, SPEC, 2, workers=1), expected)
    refused = plan_grasps(
        [sent(PointCloud(1e-4 * VIEW.points, None, VIEW.viewpoint))], hand, SPEC, 2
    )[0]
    assert "refused" in refused.meta and refused.joints.device == DEVICE


def test_the_reason_for_no_grasp_is_the_same(device, hand, few_postures):
    uncertain = ContactSpec(table=0.0, max_variance=1e-6)
    here = at_home(lambda: explain_empty(VIEW, hand, uncertain, 1))
    assert str(explain_empty(sent(VIEW), hand, uncertain, 1)) == str(here)


def test_things_of_a_scene_are_planned_where_it_is(device, hand, few_postures):
    scene = see((0.0, 0.0, 0.06, 0.1))
    same(take_target(sent(scene).select(1), 0), take_target(scene.select(1), 0))
    there = plan_scene(sent(scene), hand, starts=1, enough=0.01)
    grasps = [thing.grasps for thing in there.things if thing.grasps is not None]
    assert grasps and all(found.joints.device == DEVICE for found in grasps)


def test_an_object_is_taken_away_where_the_scene_is(device):
    scene = see((0.0, 0.0, 0.06, 0.1), (0.0, 0.1, 0.06, 0.1)).select(1)
    same(take_away(sent(scene), 2), take_away(scene, 2))


def test_completion_is_on_the_cpu(device):
    seen = estimate_normals(VIEW)
    same(silhouettes(sent(seen)), silhouettes(seen), CPU)
    same(complete_cloud(sent(seen), 0.0), complete_cloud(seen, 0.0), CPU)


def test_words_about_a_cloud_are_the_same(device):
    seen = estimate_normals(VIEW)
    assert format_report(diagnose_cloud(sent(seen), sent(UP))) == format_report(
        diagnose_cloud(seen, UP)
    )


def test_obstacles_are_asked_where_they_are(device, hand, shape, grasps):
    obstacles = Obstacles.of(estimate_occupancy(load_scene(), 1))
    vertices = extract_surface(shape, 24).vertices
    found = collision_probability(sent(hand), sent(grasps), sent(obstacles), SPEC.plane)
    same(found, collision_probability(hand, grasps, obstacles, SPEC.plane))
    assert lift_clearance(sent(vertices), sent(obstacles)) == lift_clearance(vertices, obstacles)
    same(
        spread_rows(plan_contacts(sent(shape), SPEC, 6), 3),
        spread_rows(plan_contacts(shape, SPEC, 6), 3),
    )


@pytest.mark.parametrize("name", TEXTS)
def test_what_is_written_is_the_same_wherever_hand_and_grasps_are(device, hand, grasps, name):
    expected = TEXTS[name](hand, grasps)
    for one, other in ((hand, sent(grasps)), (sent(hand), grasps), (sent(hand), sent(grasps))):
        assert TEXTS[name](one, other) == expected


@pytest.mark.parametrize("where", ["shape", "grasps", "hand", "all"])
def test_what_moves_success_is_the_same_wherever_its_parts_are(device, hand, shape, grasps, where):
    parts = {"grasps": grasps, "hand": hand, "shape": shape}
    moved = {name: sent(part) if where in (name, "all") else part for name, part in parts.items()}
    found, expected = (explain_success(**x, task=GraspTask(mass=0.8)) for x in (moved, parts))
    assert [(cost.cause, cost.sentence) for cost in found] == [
        (cost.cause, cost.sentence) for cost in expected
    ]


def test_files_are_the_same(device, shape, tmp_path):
    surface = extract_surface(shape, 24)
    hand = load_hand("allegro")
    there, here = (tmp_path / name for name in ("there", "here"))
    joints = random_joints(hand, 1, 0)
    pose = torch.eye(4, dtype=torch.float64)[None]
    grasps = grasps_from_joints(hand, joints, pose)
    same(grasps_from_joints(sent(hand), sent(joints), sent(pose)), grasps, CPU)
    for folder, to in ((there, sent), (here, lambda x: x)):
        folder.mkdir()
        save_surface(to(surface), folder / "surface.ply")
        save_cloud(to(VIEW), folder / "cloud.ply")
        save_dexgraspbench(hand, to(grasps), folder / "bench", "object")
    assert largest_std(sent(surface)) == pytest.approx(largest_std(surface))
    for name in ("surface.ply", "cloud.ply", "bench/0.npy"):
        assert (there / name).read_bytes() == (here / name).read_bytes()


def test_trials_are_drawn_on_the_cpu(device):
    noise = find_protocol("pose-noise").noise
    pivot = torch.ones(3)
    assert noise is not None
    same(draw_object_poses(noise, sent(pivot), 3, 0), draw_object_poses(noise, pivot, 3, 0), CPU)


TURNED = torch.tensor(
    [[0.0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]], dtype=torch.float64
)


def here(value: Any) -> Any:
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
        there = to(shape)
        contacts = to(grasps.contacts)
        its_hand = to(hand)
        surface = extract_surface(there, 24)
        world = CollisionWorld(field_from_surface(surface.vertices, surface.faces, 0.01), 0.0)
        problem = GraspProblem(
            its_hand, contacts, certify(contacts, SPEC), world, surface.vertices.mean(0)
        )
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
        return [
            vessel,
            vessel.predict(x),
            vessel.jet(vessel.normalise(x)),
            vessel.moved(to(TURNED)),
        ]

    same(fit(sent), fit(here))


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
def test_a_closing_is_the_same_wherever_hand_and_grasp_are(device):
    pytest.importorskip("sapien")
    hand, grasp = pinch("allegro")
    there, near = (close_hand(to(grasp), to(hand), cylinder(), QUICK) for to in (sent, here))
    assert there.held and near.held
    assert np.array_equal(there.forces, near.forces) and np.array_equal(
        there.object_pose, near.object_pose
    )


@pytest.mark.parametrize("backend", ["torchgrasp", "pytorch_kinematics"])
def test_fingertips_are_where_the_hand_is(device, hand, backend):
    joints = random_joints(hand, 5, 0)
    same(sent(hand).fingertips(sent(joints), backend), hand.fingertips(joints, backend))
    back = sent(hand).to("cpu")
    same(back.fingertips(joints, backend), hand.fingertips(joints, backend), CPU)
    same(sent(hand).jacobian(sent(joints)), hand.jacobian(joints))
