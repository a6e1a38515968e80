"""Compiled loops against the operations of torch that define them; without numba the same loops run
in Python.
"""

import dataclasses
import importlib
import math
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from tests.contacts.test_forces import tripods
from tests.make import field_of_mesh, run_python, touched_contacts
from torchgrasp import (
    Contacts,
    ContactSpec,
    PointCloud,
    critical_friction,
    load_hand,
    load_object,
    plan_grasps,
    stream_grasps,
)
from torchgrasp.contacts.critical import least_balance
from torchgrasp.contacts.descent import Stage, project, start_state
from torchgrasp.contacts.form_closure import closed_exact, maximise
from torchgrasp.contacts.problem import ContactProblem
from torchgrasp.contacts.solver import descend
from torchgrasp.foundation import fused
from torchgrasp.foundation.base import Value, named_tensors
from torchgrasp.foundation.errors import BadArgument, IndefiniteCovariance, MissingExtra
from torchgrasp.geometry.frames import rigid, rotation_from_vector
from torchgrasp.geometry.linalg import farthest_points, unit
from torchgrasp.geometry.mesh_distance import MeshSurface
from torchgrasp.ik.clearance import CollisionWorld, Obstacles
from torchgrasp.ik.configuration import Configuration, SpatialJacobian
from torchgrasp.ik.motion import _clearance
from torchgrasp.ik.refine import grasp_residuals, open_hand, refine
from torchgrasp.ik.seeds import PostureLibrary, nearest_postures
from torchgrasp.shape.completion.silhouette import Outlines
from torchgrasp.shape.completion.symmetry import SymmetryScorer
from torchgrasp.shape.conditioning import select_points
from torchgrasp.shape.estimate import Normalisation, off_surface, on_surface
from torchgrasp.shape.fit import condition, fit_shape
from torchgrasp.shape.hollow import HollowShape
from torchgrasp.shape.kernel import kernel_by_name


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    """Numbers in [-1, 1]."""
    generator = torch.Generator().manual_seed(seed)
    return 2 * torch.rand(*shape, generator=generator, dtype=torch.float64) - 1


@pytest.fixture
def both(monkeypatch):
    """Make a function's results with operations of torch, then with loops."""
    monkeypatch.setattr(fused, "has_numba", lambda: True)

    def compute(function):
        monkeypatch.setenv(fused.VARIABLE, "0")
        first = function()
        monkeypatch.setenv(fused.VARIABLE, "1")
        return first, function()

    return compute


def assert_close(found, wanted, rounding: float = 1e-9) -> None:
    """The same to a part of the largest number."""
    scale = float(wanted.abs().max())
    torch.testing.assert_close(found, wanted, rtol=0.0, atol=rounding * max(scale, 1e-3))


@pytest.fixture(scope="module")
def shape():
    """A bowl seen from above, on a table; few points, for loops in Python."""
    normals = unit(random(120, 3))
    points = 0.04 * normals + torch.tensor([0.0, 0.0, 0.04])
    cloud = PointCloud(points, normals)
    return fit_shape(cloud, table=0.0, budget=40)


@pytest.fixture(scope="module", params=["allegro", "barrett"])
def hand(request):
    return load_hand(request.param)


@pytest.fixture(scope="module")
def worlds():
    """A ball, alone, on a table, and beside an obstacle."""
    import trimesh

    ball = field_of_mesh(trimesh.creation.icosphere(subdivisions=2, radius=0.03))
    beside = dataclasses.replace(ball, origin=ball.origin + 0.05)
    other = Obstacles(beside, beside.values[None].float(), torch.tensor([0.5]).double())
    return (
        CollisionWorld(ball),
        CollisionWorld(ball, -0.02),
        CollisionWorld(ball, -0.02, other),
        CollisionWorld(None, -0.02),
    )


def postures(hand, n: int) -> Configuration:
    """Joints within the limits, some with links that collide, near the ball."""
    share = (random(n, hand.dof) + 1) / 2
    joints = hand.lower + (hand.upper - hand.lower) * share
    turn = rotation_from_vector(2 * random(n, 3, seed=1))
    return Configuration(joints, rigid(turn, 0.08 * random(n, 3, seed=2)))


def test_jets_of_a_thin_plate(shape, both):
    """At its observed points, too, where derivatives are 0 / 0."""
    x = torch.cat([0.8 * random(6, 3), shape.x[:3]])
    for function in (
        shape.mean,
        shape.mean_and_gradient,
        shape.variance,
        shape.mean_jet,
        shape.jet,
    ):
        wanted, found = both(lambda function=function: function(x))
        if isinstance(wanted, Value):
            wanted, found = (named_tensors(y).values() for y in (wanted, found))
        elif isinstance(wanted, torch.Tensor):
            wanted, found = [wanted], [found]
        for one, other in zip(found, wanted, strict=True):
            assert_close(one, other)


def test_distances_in_a_grid(both, worlds):
    """Inside, on nodes, and outside of the grid, beside one or several of its sides."""
    field = worlds[0].field
    nodes = field.origin + field.spacing * torch.tensor([[0, 0, 0], [3, 4, 5]])
    points = torch.cat([0.3 * random(40, 3), 0.05 * random(40, 3), nodes, nodes[:1] - 0.01])
    wanted, found = both(lambda: field.query(points[None]))
    for one, other in zip(found, wanted, strict=True):
        assert_close(one, other)


def test_farthest_and_nearest_points(both):
    """Fewer points than a leaf holds, and many; none of some queries is near enough."""
    for count in (5, 300):
        points = random(count, 3)
        wanted, found = both(lambda points=points: farthest_points(points, 40, first=2, tie=1e-9))
        assert torch.equal(found, wanted)
        scorer = SymmetryScorer(points, unit(points), Outlines(()), None, False, found)
        at = 1.5 * random(50, 3, seed=1)[:, None]
        wanted, found = both(lambda scorer=scorer, at=at: scorer.nearest(at, 0.3))
        assert_close(found[0], wanted[0])
        assert torch.equal(found[1], wanted[1])
        assert bool(wanted[0].isinf().any())


def test_scores_of_mirror_planes_and_the_space_beside_an_outline(both):
    """Some images are far from the cloud, some outside the outline or below the table; points lie
    beside the raster and behind the camera, too.
    """
    normals = unit(random(240, 3))
    normals = normals[normals[:, 0] > 0.2]
    seen = PointCloud(0.03 * normals, normals, torch.tensor([0.5, 0.0, 0.1]).double())
    scorer = SymmetryScorer.of(seen, -0.025)
    planes = torch.cat([unit(random(12, 3, seed=1)), 0.03 * random(12, 1, seed=2)], 1)
    for wanted, found in zip(*both(lambda: scorer.score(planes)), strict=True):
        assert wanted.unique().numel() > 8
        assert_close(found, wanted)
    points = torch.cat([0.06 * random(80, 3, seed=3), random(20, 3, seed=4)])[None]
    for look in (scorer.outline.violation, scorer.outline.hull_distance):
        wanted, found = both(lambda look=look: look(points))
        assert (wanted > 0).any() and not (wanted > 0).all()
        assert_close(found, wanted)


@pytest.mark.parametrize("friction", [0.0, 0.3, 0.8])
def test_form_closure_of_three_contacts(both, friction):
    """Some sets are closed; contacts may coincide, lie on a line, or not be numbers."""
    points = random(120, 3, 3)
    normals = unit(unit(points) + 0.3 * random(120, 3, 3, seed=1))
    points[0] = 0.0
    points[1, 1] = points[1, 0]
    points[2] = points[2, :1] * torch.tensor([[1.0], [2.0], [3.0]])
    points[3, 0, 0] = torch.nan
    normals[4, 2, 1] = torch.nan
    wanted, found = both(lambda: closed_exact(points, normals, friction))
    assert torch.equal(found, wanted)
    assert not wanted[:5].any()
    assert wanted.any() or friction == 0.0


@pytest.mark.parametrize("criterion", ["variance", "error", "both"])
def test_choice_of_observed_points(both, criterion):
    """The choice itself, and the posterior given the points; with a bound it ends early."""
    x = unit(random(60, 3))
    candidates = on_surface(x, x, torch.full_like(x[:, 0], 0.01), 0.05)
    known = off_surface(1.2 * unit(random(9, 3, seed=1)), 0.2 + 0 * x[:9, 0], 0.01)
    kernel = kernel_by_name("thin_plate", 3.6)
    for stop in (-math.inf, 1.0):
        wanted, found = both(
            lambda stop=stop: select_points(candidates, known, kernel, 12, criterion, stop)
        )
        assert torch.equal(found.picks, wanted.picks)
        assert (len(found.picks) == 12) == (stop < 0)
        assert_close(found.posterior.factor, wanted.posterior.factor)
        # the inverse of a covariance grows roundings
        assert_close(found.posterior.weights, wanted.posterior.weights, 1e-7)
    with pytest.raises(IndefiniteCovariance, match="a picked point"):
        select_points(candidates, known, kernel_by_name("thin_plate", 2.0), 12, criterion)


@pytest.mark.parametrize("size", [(2, 2), (9, 7)])
def test_distances_from_an_open_mesh(both, size):
    """Few samples are one leaf of the tree, many are not filled evenly; points touch the mesh."""
    lines = [0.03 * torch.linspace(-1.0, 1.0, k, dtype=torch.float64) for k in size]
    x, y = torch.meshgrid(*lines, indexing="ij")
    vertices = torch.stack([x, y, 4.0 * x * y], -1).reshape(-1, 3)
    first = torch.arange(len(vertices)).reshape(size)[:-1, :-1].reshape(-1, 1)
    corners = [0, size[1], size[1] + 1, 0, size[1] + 1, 1]
    faces = (first + torch.tensor(corners)).reshape(-1, 3)
    points = torch.cat([0.08 * random(30, 3), vertices, vertices[faces[:4]].mean(1)])
    for far in (False, True):

        def distance(far: bool = far) -> torch.Tensor:
            surface = MeshSurface(vertices, faces)
            return torch.from_numpy(surface.distance(points.numpy(), far))

        wanted, found = both(distance)
        assert_close(found.abs(), wanted.abs())
        apart = wanted.abs() > 1e-9
        assert apart.sum() >= 30
        assert_close(found[apart], wanted[apart])


@pytest.mark.parametrize("tips_touch", [True, False])
def test_residuals_and_jacobian_of_hands(hand, worlds, both, tips_touch):
    """The order of clearances is free: what a step is made of is compared."""
    at = postures(hand, 8)
    target = at.obj_from_hand[:, None, :3, 3] + 0.05 * random(8, len(hand.tips), 3)
    normals = unit(random(8, len(hand.tips), 3, seed=3))
    for world in worlds:
        (residual, jacobian), (found, by_step) = both(
            lambda world=world: grasp_residuals(hand, at, target, normals, world, tips_touch)
        )
        assert (residual[:, 4 * len(hand.tips) :] > 0).any()
        assert_close(found.sort(1).values, residual.sort(1).values, 1e-13)
        assert_close(by_step.mT @ by_step, jacobian.mT @ jacobian, 1e-13)
        assert_close(by_step.mT @ found[..., None], jacobian.mT @ residual[..., None], 1e-13)


def test_refined_and_opened_hands(hand, worlds, both):
    """Rounding grows with the steps, so that a few are compared."""
    at = postures(hand, 4)
    moved = Configuration(at.joints + 0.1 * random(*at.joints.shape), at.obj_from_hand)
    contacts = touched_contacts(hand, moved.joints, moved.obj_from_hand)
    for world in worlds[1:]:
        wanted, found = both(lambda world=world: refine(hand, at, contacts, world, steps=4))
        assert (wanted.joints - at.joints).abs().max() > 0.01
        torch.testing.assert_close(found.joints, wanted.joints, rtol=0, atol=1e-7)
        torch.testing.assert_close(found.obj_from_hand, wanted.obj_from_hand, rtol=0, atol=1e-7)
        std_m = torch.full_like(contacts.points[..., 0], 1e-3)
        seen = dataclasses.replace(contacts, std_m=std_m)
        wanted, found = both(lambda world=world, seen=seen: open_hand(hand, at, seen, world))
        torch.testing.assert_close(found, wanted, rtol=0, atol=1e-6)


@pytest.mark.parametrize("tracked", [True, False])
def test_a_residual_of_zero_holds_its_direction(hand, both, tracked):
    """Targets are right above the tips. A pose that requires a gradient gets none."""
    at = postures(hand, 4)
    centres = SpatialJacobian.at(hand, at).tips.permute(2, 1, 0)
    up = torch.tensor([0.0, 0.0, 1.0]).double().expand_as(centres)
    contacts = Contacts(centres - hand.tip_radius[:, None] * up + 0.01 * up, up)
    at.obj_from_hand.requires_grad_(tracked)
    wanted, found = both(lambda: refine(hand, at, contacts, CollisionWorld(), steps=1))
    torch.testing.assert_close(found.joints, wanted.joints, rtol=0, atol=1e-9)


@pytest.mark.parametrize("exact", [True, False])
def test_clearance_on_a_path(worlds, both, exact):
    centres = 0.1 * random(5, 6, 3)
    radius = 0.01 + 0.005 * random(6)
    direction = unit(random(5, 3, seed=4))
    for world in worlds:
        wanted, found = both(
            lambda world=world: _clearance(centres, radius, direction, world, exact)
        )
        assert_close(found, wanted)


@pytest.mark.parametrize("fingertips", [3, 4])
@pytest.mark.parametrize(("table", "walls"), [(0.0, 1), (None, 1), (0.0, 2)])
def test_a_stage_of_the_contact_solver(shape, both, fingertips, table, walls):
    """Sets that end, steps that are refused, and contacts outside their bounds are among them."""
    if walls == 2:
        inner = random(40, 3, seed=5)
        cavity = on_surface(0.6 * unit(inner), -unit(inner), 0.01 + 0 * inner[:, 0], 0.05)
        frame = Normalisation(shape.center, float(shape.scale))
        shape = HollowShape.join(shape, condition(cavity, frame, shape.cloud), shape.cloud)
    spec = ContactSpec(table=table, fingertips=fingertips)
    problem = ContactProblem.of(shape, spec)
    begun = 0.5 * unit(random(12, fingertips, 3))
    begun[::2] *= walls  # half of them on the outer wall
    points = project(shape, begun, 6)
    stage = Stage(0.3, 3.0, 4, exact=False)
    wanted, found = both(lambda: descend(shape, problem, start_state(shape, points), stage))
    assert (wanted.points - points).abs().max() > 0.01
    assert shape.wall_at(wanted.points.flatten(0, 1)).any(0).all()
    torch.testing.assert_close(found.points, wanted.points, rtol=0, atol=1e-7)
    torch.testing.assert_close(found.tension, wanted.tension, rtol=1e-6, atol=1e-7)
    for one, other in zip(
        named_tensors(found.jet).values(), named_tensors(wanted.jet).values(), strict=True
    ):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)


def test_linear_programmes(both):
    """The objective grows without bound where it lies outside the cone of the bounds."""
    bounds = random(30, 12, 6)
    objective = bounds.mean(1) + 0.2 * random(30, 6, seed=1)
    wanted, found = both(lambda: maximise(objective, bounds))
    unbounded = (bounds @ wanted[0][..., None]).amax((1, 2)) < 0.5
    assert unbounded.any() and not unbounded.all()
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize(("fingertips", "weight"), [(3, 0.0), (4, 0.3), (5, 0.0)])
def test_the_least_friction_that_balances(both, fingertips, weight):
    """One set is on a line, one is not finite, and one cannot push."""
    points, normals = tripods(7, 3, fingertips)
    points[1] = points[1, :1] * (1 + torch.arange(fingertips)[:, None])
    points[2, 0] = torch.nan
    if fingertips == 3:
        normals[3] = normals[3, :1]
    load = torch.zeros(7, 6, dtype=torch.float64)
    load[:, 2] = -weight
    (rows, wanted), (found_rows, found) = both(lambda: least_balance(points, normals, load))
    assert found_rows.tolist() == rows.tolist()
    assert len(rows) == (4 if fingertips == 3 else 5)
    torch.testing.assert_close(found.friction, wanted.friction, rtol=0, atol=1e-9)
    for one, other in zip(found, wanted, strict=True):
        assert_close(one, other, 1e-7)


def test_a_derivative_of_the_critical_friction(both):
    """It is that of the torch operations at the balance that the loop found."""
    points, normals = tripods(2, 3)

    def slope() -> torch.Tensor:
        x = points.clone().requires_grad_()
        return torch.autograd.grad(critical_friction(x, normals).sum(), x)[0]

    wanted, found = both(slope)
    assert wanted.abs().max() > 0.01
    assert_close(found, wanted)


@pytest.mark.parametrize("reachable", [None, lambda poses: poses[:, 2, 3] > 0])
def test_initial_postures(hand, worlds, both, reachable):
    library = PostureLibrary.of(hand, 60)
    at = postures(hand, 5)
    contacts = touched_contacts(hand, at.joints, at.obj_from_hand)
    for world in worlds:
        wanted, found = both(
            lambda world=world: nearest_postures(library, contacts, world, 4, reachable)
        )
        assert len(wanted) > 5
        for name, one in named_tensors(found).items():
            torch.testing.assert_close(one, named_tensors(wanted)[name], rtol=0, atol=0)


def test_plans_with_and_without_loops(both):
    pytest.importorskip("numba")
    cloud = load_object("cylinder").view
    spec = ContactSpec(table=0.0)
    wanted, found = both(lambda: plan_grasps(cloud, load_hand("allegro"), spec, starts=60))
    assert torch.equal(found.status, wanted.status)
    torch.testing.assert_close(found.joints, wanted.joints, rtol=0, atol=1e-4)


def test_loops_are_on_where_numba_is_installed_and_new_enough(monkeypatch):
    """One that another package brought may be broken, or too old."""
    x = torch.zeros(2, dtype=torch.float64)
    monkeypatch.delenv(fused.VARIABLE, raising=False)
    for short, on in (((0, 61), True), ((1, 0), True), ((0, 60), False), (None, False)):
        found = SimpleNamespace(version_info=SimpleNamespace(short=short)) if short else None
        monkeypatch.setitem(sys.modules, "numba", found)
        fused.can_compile.cache_clear()
        assert fused.is_fused(x) == on
    fused.can_compile.cache_clear()
    monkeypatch.setattr(fused, "can_compile", lambda: True)
    monkeypatch.setenv(fused.VARIABLE, "0")
    assert not fused.is_fused(x)
    monkeypatch.setenv(fused.VARIABLE, "yes")
    with pytest.raises(
        BadArgument, match="TORCHGRASP_FUSED: expected 0, 1, or no value, got 'yes'"
    ):
        fused.is_fused(x)


def test_loops_are_demanded_and_take_plain_float64_alone(monkeypatch):
    x = torch.zeros(2, dtype=torch.float64)
    monkeypatch.setenv(fused.VARIABLE, "1")
    monkeypatch.setattr(fused, "has_numba", lambda: False)
    with pytest.raises(MissingExtra, match=r"TORCHGRASP_FUSED=1 needs numba.*torchgrasp\[fast\]"):
        fused.is_fused(x)
    with pytest.raises(MissingExtra):  # at the call, before any work
        stream_grasps(load_object("cylinder").view, load_hand("allegro"))
    monkeypatch.setattr(fused, "has_numba", lambda: True)
    assert fused.is_fused(x)
    assert not fused.is_fused(x.float())
    assert not fused.is_fused(x, x.clone().requires_grad_())
    seen = list[bool]()
    torch.vmap(lambda y: seen.append(fused.is_fused(y)) or y)(x)
    assert seen == [False]


def test_gradients_go_through_operations_of_torch(shape, monkeypatch):
    monkeypatch.setenv(fused.VARIABLE, "1")
    monkeypatch.setattr(fused, "has_numba", lambda: True)
    x = (0.5 * random(3, 3)).requires_grad_()
    distance, gradient = shape.mean_and_gradient(x)
    (slope,) = torch.autograd.grad(distance.sum(), x)
    torch.testing.assert_close(slope, gradient.detach())


def import_file(path: Path):
    """The module of a file, as a new process finds it."""
    sys.modules.pop(path.stem, None)
    importlib.invalidate_caches()
    return importlib.import_module(path.stem)


def test_changed_loops_are_compiled_anew(tmp_path, monkeypatch):
    """Also those of another file, as after an upgrade."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    inner, outer = tmp_path / "inner_loop.py", tmp_path / "outer_loop.py"
    head = "from torchgrasp.foundation.fused import compiled, inlined\n"
    text = "from inner_loop import f\n@compiled\ndef g(x):\n    return 2.0 * f(x)\n"
    outer.write_text(head + text)
    for k in (1.0, 3.0):
        inner.write_text(f"{head}@inlined\ndef f(x):\n    return x + {k}\n")
        import_file(inner)
        assert import_file(outer).g(1.0) == 2 + 2 * k


def test_a_numba_that_cannot_be_imported_is_no_numba_that_is_missing(tmp_path, monkeypatch):
    """Loops in Python would be slow without a word."""
    monkeypatch.delitem(sys.modules, "numba", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "numba.py").write_text("raise ImportError('numba needs another numpy')")
    with pytest.raises(ImportError, match="another numpy"):
        fused.inlined(both)


def test_loops_need_no_folder_for_machine_code():
    """A function that is in no file has none."""
    names = {}
    exec("def double(x):\n    return 2.0 * x", names)
    assert fused.compiled(names["double"])(3.0) == 6


PLAN = """if True:
    import os, sys
    import torchgrasp
    print(*(x for x in sys.modules if ".fused_" in x or x == "numba"), "no loops")
    from tests.test_fused import *
    os.environ[fused.VARIABLE] = "0"
    shape = fit_shape(load_object("jug").view, table=0.0)
    points = project(shape, 0.5 * unit(random(50, 3, 3)), 6)
    problem = ContactProblem.of(shape, ContactSpec(table=0.0))
    state = start_state(shape, points)
    os.environ[fused.VARIABLE] = "1"
    farthest_points(points[0], 2)
    print(descend(shape, problem, state, Stage(0.0, 3.0, 30, exact=False)).points.tolist())
"""
"""Two loops: the first is told, the second would be told again."""


def test_a_process_that_compiles_says_so_once_and_has_the_bits_of_one_that_loads(
    tmp_path, monkeypatch
):
    """A first plan that takes a minute more would look broken; an import brings in no loops."""
    pytest.importorskip("numba")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    first, second = (run_python("-c", PLAN) for _ in range(2))
    assert first.stdout == second.stdout and first.stdout.startswith("no loops\n[[[")
    told = [said.stderr.count("compiling loops, once") for said in (first, second)]
    assert told == [1, 0]
