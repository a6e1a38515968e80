"""What the picture of a scene and the hand say against an object, before it is planned."""

import dataclasses
import itertools

import pytest
import torch
import trimesh

from tests.make import HALF, box, half_ball, halved, load_hand, see
from torchgrasp import ContactSpec, Scene, Status, plan_scene
from torchgrasp.cloud.camera import look_at, render_depth
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.planner import ThingPlan
from torchgrasp.planner.graspable import hand_span, is_vague, judge_things, order_by_ease
from torchgrasp.planner.objects import pose_request, take_target
from torchgrasp.planner.ranking import rank
from torchgrasp.planner.request import Request

HAND = load_hand("allegro")
BOX = (0.0, 0.0, 0.06, 0.1)


def without(scene: Scene, rows: torch.Tensor) -> Scene:
    """Return the scene without the depth of some of its points."""
    depth = scene.image.depth.clone()
    labels = torch.zeros(scene.image.depth.shape, dtype=torch.int64)
    depth[tuple(scene.pixels[rows].T)] = 0.0
    labels[tuple(scene.pixels.T)] = scene.labels
    image = scene.image
    return Scene.from_depth(
        depth, image.intrinsics, image.obj_from_camera, labels=labels, table=scene.table
    )


def glass() -> Scene:
    """Return the scene of a box of which a stripe in five has a depth."""
    scene = see(BOX)
    return without(scene, (scene.labels == 1) & (scene.pixels[:, 1] % 20 > 3))


def beside_table() -> Scene:
    """Return the scene of two boxes; the table is seen around the second one only."""
    scene = see((-0.2, 0.3, 0.06, 0.1), BOX)
    return without(scene, (scene.labels == 0) & (scene.points[:, :2].norm(dim=1) > 0.2))


def speck() -> Scene:
    """Return the scene of a box of which sixty points are known."""
    scene = see(BOX)
    return dataclasses.replace(scene, labels=scene.labels * (scene.labels.cumsum(0) <= 60))


SCENES = {
    Status.OK: lambda: see(BOX),
    Status.FEW_PIXELS: speck,
    Status.OFF_TABLE: beside_table,
    Status.CUT_OFF: lambda: see((-0.123, 0.338, 0.06, 0.1), BOX),
    Status.NO_DEPTH: glass,
    Status.TOO_LOW: lambda: see((0.0, 0.0, 0.1, 0.0035)),
    Status.TOO_WIDE: lambda: see((0.0, 0.0, 0.32, 0.1)),
}


@pytest.mark.parametrize("status", SCENES)
def test_an_object_is_judged_by_its_picture(status):
    assert judge_things(SCENES[status](), HAND)[1] is status


def test_a_lower_object_than_the_least_height_offers_no_rim_on_which_a_tip_sticks():
    slope = torch.linspace(0.0, 1.0, 10_001, dtype=torch.float64)
    rim = 0.003
    for friction, radius in itertools.product((0.0, 0.3, 0.8), (0.008, 0.012, 0.02)):
        spec = ContactSpec(friction=friction, edges=1024, tip_radius=radius)
        sticks = slope <= friction * (1 - slope**2).sqrt()
        lowest = (radius - radius * slope + rim - rim * slope)[
            sticks
        ].min()  # the tip's centre is a radius high
        assert spec.least_height == pytest.approx(float(lowest), abs=1e-5)
        assert dataclasses.replace(spec, flat_radius=rim).least_height == pytest.approx(
            radius + rim
        )


def test_only_objects_beside_the_table_are_refused_cut_off_feet_and_distance_refuse_nothing():
    assert judge_things(beside_table(), HAND)[2] is Status.OK
    scene = see((0.262, 0.095, 0.03, 0.12), (-0.1, 0.0, 0.06, 0.1))
    assert int(scene.pixels[scene.labels == 1, 0].max()) == scene.image.depth.shape[0] - 1
    assert judge_things(scene, HAND)[1] is Status.OK
    near = see((0.1, 0.0, 0.06, 0.1), (-0.15, 0.0, 0.06, 0.1))
    far = None
    coarse = dataclasses.replace(near.image, intrinsics=near.image.intrinsics / 40)
    far = dataclasses.replace(near, image=coarse)
    assert order_by_ease(near) in ([1, 2], [2, 1]) and order_by_ease(far) == order_by_ease(near)


def test_a_hand_spans_what_its_pads_enclose_and_a_shape_that_may_be_anything_is_vague():
    spans = {name: hand_span(load_hand(name)) for name in ("shadow", "allegro", "barrett")}
    assert list(spans) == sorted(spans, key=spans.__getitem__)
    assert all(0.1 < span < 0.4 for span in spans.values())
    assert not is_vague(half_ball(-0.5, 1.0)) and is_vague(half_ball(0.8, 500.0))


def test_refused_objects_are_not_planned(monkeypatch):
    scene = see((0.2, 0.0, 0.1, 0.004), BOX, (-0.15, 0.1, 0.1, 0.0035))
    planned = []

    def plan(scene, plan):
        planned.append(scene.target)
        return ThingPlan(scene.target, 0.0)

    monkeypatch.setattr("torchgrasp.planner.scene_plan._plan_thing", plan)
    plan_scene(scene, HAND, starts=5)
    assert planned == [2]


def test_a_vague_shape_ends_the_planning_with_its_status(monkeypatch):
    monkeypatch.setattr("torchgrasp.planner.scene_plan.is_vague", lambda shape: True)
    (thing,) = plan_scene(see(BOX), HAND, starts=5).things
    assert (
        thing.status is Status.TOO_VAGUE
        and thing.reason == thing.status.sentence
        and thing.grasps is None
    )


def see_box(size: tuple[float, float, float], x: float, y: float, distance: float = 0.7) -> Scene:
    """Return the scene of a box on the table, and of a smaller one beside it."""
    box = trimesh.creation.box(size)
    cube = trimesh.creation.box([0.05, 0.05, 0.03])
    box.apply_translation([x, y, size[2] / 2])
    cube.apply_translation([0.1, -0.12, 0.015])
    camera = look_at(20.0, 45.0, distance)
    depth, labels = render_depth([box, cube], camera)
    return Scene.from_depth(halved(depth), HALF, camera, labels=halved(labels), table=0.0)


BEYOND = {
    "a bar of 1 m": lambda: see_box((0.06, 1.0, 0.06), 0.0, 0.0, 1.6),
    "a bar of 1 m, cut off twice": lambda: see_box((0.06, 1.0, 0.06), 0.0, 0.0),
    "a box of 1 m": lambda: see_box((1.0, 1.0, 0.06), 0.0, 0.55, 2.0),
    "a box cut off by half, along": lambda: see_box((0.06, 0.24, 0.06), -0.12, 0.34),
    "a box cut off by half, across": lambda: see_box((0.06, 0.06, 0.2), -0.11, 0.36),
}


def is_unknown(scene: Scene) -> bool:
    """Return whether the success of a good grasp of the first object is unknown."""
    objects = pose_request(Request(take_target(scene.select(1), 0), HAND), HAND)
    grasps = load_shipped_grasp("jug", "allegro")
    (ranked,) = rank(objects, grasps, torch.zeros_like(grasps.status))
    return bool(ranked.success.isnan().all())


@pytest.mark.filterwarnings("ignore:the border")
@pytest.mark.parametrize("name", BEYOND)
def test_what_no_trial_supports_has_a_status_or_an_unknown_success_and_comes_last(name):
    scene = BEYOND[name]()
    assert order_by_ease(scene) == [2, 1]
    assert judge_things(scene, HAND)[1] is not Status.OK or is_unknown(scene)


def test_the_success_of_a_good_grasp_of_a_whole_box_is_known():
    assert not is_unknown(see(BOX))


@pytest.mark.parametrize("aside", [0.03, 0.2])
def test_success_is_unknown_for_a_target_much_of_which_another_object_hides(aside):
    target = trimesh.creation.box([0.06, 0.06, 0.12]).apply_translation([0.0, 0.0, 0.06])
    front = trimesh.creation.box([0.05, 0.05, 0.14]).apply_translation([0.12, aside, 0.07])
    camera = look_at(0.0, 30.0, 0.7)
    depth, labels = render_depth([target, front], camera)
    scene = Scene.from_depth(halved(depth), HALF, camera, labels=halved(labels), table=0.0)
    objects = pose_request(Request(scene.select(1), HAND), HAND)
    grasps = load_shipped_grasp("jug", "allegro")
    (ranked,) = rank(objects, grasps, torch.zeros_like(grasps.status))
    hidden = aside < 0.1
    assert bool(scene.select(1).covers) == hidden
    assert bool(ranked.known.any()) != hidden


# each time two boxes: sizes and places; only the target of the last has a sure outline
GUESSED = {
    "touch": [((0.06, 0.08, 0.12), (-0.031, 0.0)), ((0.06, 0.1, 0.05), (0.03, 0.02))],
    "gaps": [((0.02, 0.16, 0.02), (0.0, 0.0)), ((0.14, 0.02, 0.02), (0.08, 0.08))],
    "apart": [((0.05, 0.05, 0.09), (0.0, -0.06)), ((0.05, 0.05, 0.09), (0.0, 0.06))],
}


@pytest.mark.parametrize("kind", GUESSED)
def test_success_is_unknown_for_a_clicked_target_whose_outline_is_a_guess(kind):
    camera = look_at(20.0, 45.0, 0.6)
    depth, labels = map(halved, render_depth([box(*one) for one in GUESSED[kind]], camera))
    row, column = torch.nonzero(labels == 1).double().mean(0).round().int().tolist()
    for given in ({"point": (column, row)}, {"mask": labels == 1}):
        scene = Scene.from_depth(depth, HALF, camera, table=0.0, **given)
        objects = pose_request(Request(scene, HAND), HAND)
        grasps = load_shipped_grasp("jug", "allegro")
        (ranked,) = rank(objects, grasps, torch.zeros_like(grasps.status))
        unknown = kind != "apart" and "point" in given
        assert bool(scene.doubts) == unknown and bool(ranked.known.any()) != unknown
        assert any("its success is unknown: give its mask" in x for x in scene.advice) == unknown
        assert set(scene.doubts) <= set(scene.advice)


def test_a_heap_of_specks_costs_no_planning(monkeypatch):
    scene = see(BOX, half=False)  # of each speck some pixels are drawn
    tile = scene.pixels // 8
    labels = torch.where(scene.labels == 0, 1 + tile[:, 0] % 5 + 5 * (tile[:, 1] % 6), 0) * (
        tile.sum(-1) % 9 == 0
    )
    drawn = torch.rand(len(labels), generator=torch.Generator().manual_seed(0)) < 0.02
    many = dataclasses.replace(scene, labels=labels * drawn)
    monkeypatch.setattr("torchgrasp.planner.scene_plan._plan_thing", None)
    plan = plan_scene(many, HAND)
    assert len(plan.things) == 30 and {thing.status for thing in plan.things} == {Status.FEW_PIXELS}


@pytest.mark.parametrize("label", [1, 2])
def test_an_object_partly_hidden_is_less_easy(label):
    scene = see((-0.1, 0.0, 0.06, 0.1), (0.1, 0.0, 0.06, 0.1))
    row, column = scene.pixels[scene.labels == label].double().mean(0)
    hidden = (scene.labels == label) & (scene.pixels[:, 0] > row) & (scene.pixels[:, 1] > column)
    assert (
        order_by_ease(dataclasses.replace(scene, labels=torch.where(hidden, 0, scene.labels)))[-1]
        == label
    )


@pytest.mark.parametrize(("stray", "cut"), [(3, False), (12, True)])
def test_a_few_pixels_at_the_border_are_noise_and_cut_no_object_off(stray, cut):
    """An object of 100 x 10 pixels is parallel to the lower border of the image, and near it."""
    scene = see(BOX)
    row, column = scene.pixels.T
    row = scene.image.depth.shape[0] - 1 - row
    inside = (row > 2) & (row <= 12) & (column >= 60) & (column < 160)
    some = torch.linspace(60, 159, stray).round().long()
    inside |= (row == 0) & torch.isin(column, some)
    scene = dataclasses.replace(scene, labels=inside.long(), table=None)
    assert (judge_things(scene, HAND)[1] is Status.CUT_OFF) == cut


@pytest.fixture
def unclear(monkeypatch):
    """Scenes in which the camera sees all objects equally well."""
    monkeypatch.setattr("torchgrasp.planner.graspable._clarity", lambda scene, pixels: 0.0)


@pytest.mark.parametrize(("gap", "place"), [(0.08, 2), (0.03, 0)])
def test_free_space_makes_an_object_easier_up_to_what_a_hand_needs(unclear, gap, place):
    """A low box far from all others competes with two taller ones that leave a gap [m]."""
    low = (0.0, -0.2, 0.06, 0.05)
    scene = see(low, (0.0, 0.03, 0.06, 0.07), (0.0, 0.09 + gap, 0.06, 0.07))
    assert order_by_ease(scene).index(1) == place


@pytest.mark.parametrize(("heights", "taller_first"), [((0.03, 0.06), True), ((0.1, 0.2), False)])
def test_height_makes_an_object_easier_up_to_what_a_hand_needs(unclear, heights, taller_first):
    """Objects that are equally easy keep the order of their labels."""
    low, tall = heights
    scene = see((0.0, -0.15, 0.06, low), (0.0, 0.15, 0.06, tall))
    swapped = dataclasses.replace(scene, labels=(3 - scene.labels) % 3)
    assert order_by_ease(scene) == ([2, 1] if taller_first else [1, 2])
    assert order_by_ease(swapped) == [1, 2]


@pytest.mark.parametrize(("slab", "place"), [((0.054, 0.06), -1), ((0.0, 0.012), 0)])
def test_a_quarter_of_an_object_under_another_is_worse_than_a_neighbour_and_a_corner_is_not(
    unclear, slab, place
):
    """A slab hangs over the first box; two others leave 25 mm between each other."""
    x, width = slab
    pair = (0.0, -0.1, 0.06, 0.05), (0.0, -0.185, 0.06, 0.05)
    scene = see((0.0, 0.2, 0.06, 0.05), (x, 0.2, width, 0.01, 0.15), *pair)
    order = [label for label in order_by_ease(scene) if label != 2]
    assert order[place] == 1
