"""Drags of a low box to the edge of its table, and the grasps there, against oracles of their own."""

import dataclasses
import functools

import pytest
import torch
import trimesh

from tests import dragged
from tests.dragged import BOX, DISTANCE, FRICTION, OUTWARD, SIZE, TABLE_FRICTION, VIEW, ending
from tests.make import load_hand, near, random_motion, real, see
from tests.settings import other_settings
from torchgrasp import ContactSpec, GraspTask, Plane
from torchgrasp.foundation.base import named_tensors
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply, inverse
from torchgrasp.geometry.plane import move
from torchgrasp.ik.press import press_postures
from torchgrasp.planner.drag_plan import (
    DRAG,
    DragPlan,
    _is_steady,
    _Top,
    find_drag,
    pressing_force,
)
from torchgrasp.planner.edge import _brought, plan_edge_grasps
from torchgrasp.planner.objects import ShapedObject
from torchgrasp.planner.request import Request
from torchgrasp.shape.surface import Mesh, extract_mesh
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.specs import GRAVITY

HANDS = ["allegro", "barrett"]
HALF = real(SIZE) / 2
MOST_OFF = 0.003
"""Greatest error [m] of the estimated height of the box's top."""


@pytest.fixture(params=HANDS)
def found(request):
    """A hand, and its drag and grasps of the box."""
    return dragged.dragged(request.param)


def quick(cloud=VIEW, distance=DISTANCE, table=None, starts=4, **changes):
    """A plan of few starts."""
    options = {"friction": FRICTION, "table_friction": TABLE_FRICTION} | changes
    table = ending(distance) if table is None else table
    spec = ContactSpec(options.pop("friction"), table=table)
    return plan_edge_grasps(cloud, load_hand("barrett"), spec, starts, **options)


def spheres_of(hand, joints):
    """Centres (s, 3) [m] of the hand's collision spheres by the chain of pytorch-kinematics."""
    poses = hand.chain.forward_kinematics(hand.expand(joints[None]))
    links = torch.cat([poses[name].get_matrix() for name in hand.tree.link_names])
    spheres = hand.collision_spheres
    return apply(links[spheres.link_index], spheres.center[:, None])[:, 0]


def from_box(points, shift=(0.0, 0.0, 0.0)):
    """Signed distances (n,) [m] of points from the true box, moved by a shift: in closed form."""
    beyond = (points - real(shift) - real([0.0, 0.0, SIZE[2] / 2])).abs() - HALF
    return beyond.clamp_min(0.0).norm(dim=-1) + beyond.amax(-1).clamp_max(0.0)


def test_a_drag_leads_across_the_edge_and_leaves_the_centre_behind_it(found):
    drag = found.plan.drag
    assert found.plan.reason == ""
    along = float(drag.displacement @ OUTWARD)
    near(drag.displacement, along * OUTWARD, 1e-9)
    # the centre of mass of the estimated shape, and the true one
    surface = extract_mesh(found.plan.shape)
    mesh = trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy())
    behind = DISTANCE - float(torch.from_numpy(mesh.center_mass.copy()) @ OUTWARD)
    # the shape is that after the drag; the planner has another estimate of its centre
    assert behind == pytest.approx(DRAG.behind, abs=2e-3)
    assert DISTANCE - along == pytest.approx(DRAG.behind, abs=5e-3)
    assert drag.table.describe() == ending(DISTANCE).describe()


def test_pressing_feet_stand_on_the_true_top_and_end_behind_the_edge(found):
    drag = found.plan.drag
    feet = drag.feet[drag.presses]
    assert 1 <= len(feet) <= 2
    assert bool(drag.feet[~drag.presses].isnan().all())
    assert bool((feet[:, :2].abs() < HALF[:2]).all())
    near(feet[:, 2], torch.full_like(feet[:, 2], SIZE[2]), MOST_OFF)
    behind = DISTANCE - (feet + drag.displacement) @ OUTWARD
    assert float(behind.min()) > DRAG.supported - 1e-3
    # they are the lowest points of the tips
    tips = apply(drag.obj_from_hand, found.hand.tip_centres(drag.joints))[drag.presses]
    lowest = tips - found.hand.tips.radius[drag.presses, None] * real([0.0, 0.0, 1.0])
    near(lowest, feet, 1e-9)


def test_all_else_of_the_hand_keeps_clear_of_object_and_table(found):
    drag = found.plan.drag
    spheres = found.hand.collision_spheres
    pressing = [k for k, on in enumerate(drag.presses.tolist()) if on]
    tips = spheres.touching & torch.isin(spheres.finger, torch.tensor(pressing))
    centres = apply(drag.obj_from_hand, spheres_of(found.hand, drag.joints))
    room = spheres.radius
    assert float((centres[:, 2] - room).min()) > SIZE[2] - MOST_OFF
    for height in torch.linspace(0.0, DRAG.approach, 11).tolist():
        above = centres + height * real([0.0, 0.0, 1.0])
        clear = from_box(above) - room
        assert float(clear[~tips].min()) > 0
        assert float(clear[tips].min()) > height - MOST_OFF
    # the object goes along below the hand: their distance stays, and the table is level
    near(drag.displacement[2], real(0.0), 1e-9)


def test_grasps_are_of_the_object_where_the_drag_leaves_it(found):
    hand, plan = found
    good = plan.grasps.executable
    assert len(good)
    assert good.table.describe() == ending(DISTANCE).describe()
    points = good.contacts.points
    off = from_box(points, plan.drag.displacement.tolist()).abs()
    assert float((off < 6e-3).double().mean()) > 0.9
    inward = -good.contacts.normals[..., 2]
    below = points[inward > 0.5]  # contacts on the underside
    assert len(below) and float((below @ OUTWARD).min()) > DISTANCE
    radius = hand.collision_spheres.radius - 1e-4
    for grasp in (good[k] for k in range(len(good))):
        centres = apply(grasp.obj_from_hand[0], spheres_of(hand, grasp.joints[0]))
        # a sphere is out of the ledge if its centre is above, beyond, or as far from the corner
        corner = torch.stack([centres[:, 2], centres @ OUTWARD - DISTANCE], 1)
        out = corner.clamp_min(0.0).norm(dim=1) + corner.amax(1).clamp_max(0.0)
        assert float((out - radius).min()) > 0


@pytest.mark.parametrize(("friction", "table"), [(0.6, 0.2), (0.8, 0.1), (0.5, 0.4)])
@pytest.mark.parametrize("mass", [0.1, 0.4])
def test_the_pressing_force_moves_the_object_by_coulombs_law(friction, table, mass):
    force = pressing_force(mass, friction, table)
    pressed = torch.linspace(0.0, 100.0, 1_000_001).double()
    moves = friction * pressed > table * (pressed + mass * GRAVITY)
    least = float(pressed[moves].min())
    wanted = max(DRAG.reserve * least, DRAG.weights * mass * GRAVITY, DRAG.least)
    wanted = min(wanted, DRAG.most)
    if DRAG.enough * least > DRAG.most:
        assert force is None
    else:
        assert force == pytest.approx(wanted, abs=1e-3)
        assert force > 1.4 * least


def test_the_plans_force_is_that_of_the_greatest_mass_and_a_low_friction(found):
    assert found.plan.drag.force == pressing_force(dragged.MASS, FRICTION, TABLE_FRICTION)
    task = GraspTask(Distribution.between(0.1, 0.4))
    drag = quick(friction=Distribution.between(0.5, 0.7), task=task).drag
    assert drag.force == pytest.approx(pressing_force(0.4, 0.52, TABLE_FRICTION), rel=1e-9)


@functools.cache
def still():
    return quick()


def test_a_plan_moves_with_cloud_camera_and_table():
    plan = still()
    motion = random_motion(5)
    there = quick(move(VIEW, motion), table=ending(DISTANCE).moved(motion))
    drag, other = plan.drag, there.drag
    back = inverse(motion)
    near(back @ other.obj_from_hand, drag.obj_from_hand, 1e-6)
    near(back[:3, :3] @ other.displacement, drag.displacement, 1e-6)
    near(
        apply(back, other.feet)[drag.presses],
        drag.feet[drag.presses],
        1e-6,
    )
    assert torch.equal(drag.joints, other.joints) and torch.equal(drag.presses, other.presses)
    assert drag.force == other.force
    found = named_tensors(move(there.grasps, back))
    for name, x in named_tensors(plan.grasps).items():
        torch.testing.assert_close(found[name], x, rtol=0, atol=1e-6, msg=name)
    near(apply(back, there.shape.center[None])[0], plan.shape.center, 1e-6)
    near(plan.shape.center[2], SIZE[2] / 2 * torch.ones(()).double(), MOST_OFF)


def test_a_drag_has_the_same_bits_under_any_setting_of_torch():
    plan = still()
    with other_settings():
        again = quick()
    found = named_tensors(again.drag)
    for name, x in named_tensors(plan.drag).items():
        torch.testing.assert_close(found[name], x, rtol=0, atol=0, equal_nan=True, msg=name)
        assert x.device.type == "cpu" and x.dtype in (torch.float64, torch.bool)
    assert again.drag.force == plan.drag.force
    assert torch.equal(plan.grasps.status, again.grasps.status)


def test_objects_that_need_no_drag_or_allow_none_have_a_reason():
    hanging = quick(distance=0.01)
    assert hanging.drag is None and "hangs over" in hanging.reason
    assert len(hanging.grasps)
    near(hanging.shape.center[:2], torch.zeros(2).double(), 5e-3)
    heavy = quick(task=GraspTask(5.0), starts=1)
    assert heavy.drag is None and "5 kg" in heavy.reason


def test_an_object_without_a_level_top_has_no_place_to_press():
    hand = load_hand("barrett")
    spec = ContactSpec(FRICTION, table=ending(DISTANCE))
    cone = trimesh.creation.cone(0.03, 0.06)
    surface = Mesh(torch.from_numpy(cone.vertices.copy()), torch.from_numpy(cone.faces.copy()))
    object_ = dataclasses.replace(ShapedObject.of(Request(VIEW, hand, spec)), surface=surface)
    rest = dragged.MASS, FRICTION, TABLE_FRICTION
    assert "no posture" in find_drag(object_, hand, ending(DISTANCE), *rest)


def test_arguments_that_cannot_be_are_refused():
    with pytest.raises(BadArgument, match=r"spec\.table: expected a plane with an edge"):
        quick(table=Plane.horizontal(0.0))
    with pytest.raises(BadArgument, match=r"spec\.table: expected a plane with an edge.*no table"):
        plan_edge_grasps(VIEW, load_hand("barrett"), ContactSpec())
    for friction in (0.2, Distribution.between(0.1, 0.9)):
        with pytest.raises(BadArgument, match="table_friction: expected less than the friction"):
            quick(friction=friction)
    with pytest.raises(BadArgument, match=r"spec\.table: .*an edge \d+ mm behind the object's"):
        quick(distance=-0.04)
    with pytest.raises(
        BadArgument, match=r"spec\.table: expected one within 2 m.* got an edge 149\.9 m from all"
    ):
        quick(distance=150.0)


@functools.cache
def neighboured():
    """A scene of a low body at the origin, and a box 90 mm from it along x."""
    scene = see((0.0, 0.0, 0.06, 0.012), (0.09, 0.0, 0.04, 0.06))
    (label,) = [
        k
        for k in scene.things
        if float(scene.select(k).cloud().points.double().mean(0)[:2].norm()) < 0.03
    ]
    return scene.select(label)


@pytest.fixture(scope="module")
def beside_neighbour():
    """The low body of the scene, with its estimated shape."""
    return ShapedObject.of(Request(neighboured(), load_hand("barrett")))


def test_a_drag_goes_around_a_neighbour_or_there_is_none(beside_neighbour):
    out = real([1.0, 0.0, 0.0])
    level = neighboured().table
    drag = quick(neighboured(), table=level.ending(0.2 * out, out), starts=1).drag
    if drag is not None:
        # the centre of a body of half 30 mm passes the box of half 20 mm
        box = real([0.09, 0.0])
        way = torch.linspace(0, 1, 200).double()[:, None] * drag.displacement[:2]
        assert float((way - box).norm(dim=1).min()) > 0.045
    rest = dragged.MASS, FRICTION, TABLE_FRICTION
    hand = load_hand("barrett")
    away, far = (level.ending(-distance * out, -out) for distance in (0.115, 0.3))
    assert isinstance(find_drag(beside_neighbour, hand, away, *rest), DragPlan)
    assert "known only" in find_drag(beside_neighbour, hand, far, *rest)


def test_after_a_drag_the_neighbours_are_where_they_were(beside_neighbour):
    object_ = beside_neighbour
    shift = real([0.03, -0.02, 0.0])
    brought = _brought(object_, shift)
    places = object_.obstacles.field.origin.double() + 0.3 * torch.rand(500, 3).double()
    way = inverse(object_.obj_from_upright)[:3, :3] @ shift
    # an obstacle of the object's frame is nearer by the drag
    near(
        brought.field.query(places - way)[0],
        object_.obstacles.field.query(places)[0],
        1e-6,
    )


def slide(stiffness, way, pressed, weight):
    """Drag a fingertip with a spring (3, 3) [N/m] along a unit vector, the palm at its height.

    Return the change of the pressing force for each newton of the drag, and whether the object
    moves before the tip slips on it.
    """
    along = torch.linspace(0.0, 0.2, 20_001).double()[1:, None]
    force = real([0.0, 0.0, -pressed]) + along * (stiffness @ way)
    across = force[:, :2].norm(dim=1)
    moves = across > TABLE_FRICTION * (weight - force[:, 2])
    slips = across > -FRICTION * force[:, 2]
    change = float((-force[0, 2] - pressed) / (force[0] @ way))
    first = [int(x.int().argmax()) if bool(x.any()) else len(x) for x in (moves, slips)]
    return change, first[0] < first[1]


def test_postures_that_press_steadily_drag_and_do_not_slip():
    postures = press_postures(load_hand("allegro"))
    angle = torch.arange(6).double()
    ways = torch.stack([angle.cos(), angle.sin(), torch.zeros(6).double()], 1)
    steady = _is_steady(postures, ways)
    pressed = pressing_force(dragged.MASS, FRICTION, TABLE_FRICTION)
    weight = dragged.MASS * GRAVITY
    unsteady = 0
    for p, t in ((p, t) for p in range(0, len(postures), 8) for t in range(len(ways))):
        fingers = torch.nonzero(postures.presses[p])[:, 0].tolist()
        n = len(fingers)
        found = [slide(postures.stiffness[p, f], ways[t], pressed / n, weight / n) for f in fingers]
        within = [-DRAG.unloading <= change <= DRAG.digging for change, _ in found]
        assert bool(steady[p, t]) == all(within)
        holds = all(moves for _, moves in found)
        assert holds or not steady[p, t]
        unsteady += not holds
    assert unsteady and bool(steady.any())


def test_a_top_is_flat_inside_its_outline_in_a_mesh_of_any_fineness():
    for cells in (4, 40):
        x = torch.linspace(-0.15, 0.15, 3 * cells + 1).double()
        y = torch.linspace(-0.1, 0.1, 2 * cells + 1).double()
        here = torch.stack(torch.meshgrid(x, y, indexing="ij"), -1)
        here = torch.cat([here, torch.full_like(here[..., :1], 0.02)], -1)
        one = torch.stack([here[:-1, :-1], here[1:, :-1], here[1:, 1:]], -2).flatten(0, 1)
        two = torch.stack([here[:-1, :-1], here[1:, 1:], here[:-1, 1:]], -2).flatten(0, 1)
        top = _Top(torch.cat([one, two]))
        places = 2 * torch.rand(2000, 3, generator=torch.Generator().manual_seed(0)).double() - 1
        places = places * real([0.2, 0.15, 0.0])
        height, flat = top.look(top.stands(OUTWARD), places[:, :2])
        near(height, torch.full_like(height, 0.02), 1e-12)
        inside = (places.abs()[:, :2] < real([0.15, 0.1]) - 0.01).all(1)
        outside = (places.abs()[:, :2] > real([0.15, 0.1]) + 0.003).any(1)
        assert bool(flat[inside].all())
        assert not bool(flat[outside].any())
    assert BOX.is_watertight
    step = torch.cat([one, two + real([0.0, 0.0, DRAG.flat + 1e-3])])
    top = _Top(step)
    assert not bool(top.look(top.stands(OUTWARD), real([[0.0, 0.0]]))[1].any())
