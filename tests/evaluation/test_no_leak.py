"""The controller knows what the robot was told: nothing of the true object, its table or its place
comes to it.
"""

import ast
import dataclasses
import functools
import inspect
import math
import typing
from pathlib import Path

import pytest
import torch
import trimesh

import torchgrasp
from tests.make import real
from tests.pinch import cylinder, pinch
from torchgrasp import (
    ClosingReference,
    ContactSpec,
    GraspController,
    Plane,
    TrialSpec,
    load_grasps,
    load_object,
    plan_grasps,
)
from torchgrasp.control import Observation
from torchgrasp.data.accept import as_cloud
from torchgrasp.evaluation import EvaluationSpec, GraspTrial, Truth
from torchgrasp.evaluation.trial import TrialDriver, derive_reference
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Taken
from torchgrasp.geometry.frames import inverse, rigid, rotation_from_vector
from torchgrasp.geometry.plane import read_plane
from torchgrasp.sim import Neighbour
from torchgrasp.sim.scene_spec import Body, SceneSpec
from torchgrasp.sim.simulated_scene import SimulatedScene
from torchgrasp.values.planning import PointCloud

TILT = math.radians(2)
WRONG = Plane(torch.tensor([math.sin(TILT), 0.0, math.cos(TILT)], dtype=torch.float64), 0.003)
"""A table 3 mm too high and tilted by 2 degrees."""
SECRETS = (
    Truth,
    SceneSpec,
    Body,
    Neighbour,
    SimulatedScene,
    GraspTrial,
    TrialSpec,
    EvaluationSpec,
    trimesh.Trimesh,
)
"""The types that hold a part of the truth."""


def driver(told=None, spec=None, **truth):
    hand, grasp = pinch("allegro")
    truth = {"mesh": cylinder(), "parts": [cylinder()]} | truth
    return TrialDriver(
        GraspTrial(hand, grasp, Truth(**truth), told=told), TrialSpec() if spec is None else spec
    )


def assert_same_plane(found, known, tolerance=1e-8):
    assert torch.allclose(found.normal, known.normal, rtol=0, atol=tolerance)
    assert found.offset == pytest.approx(known.offset, abs=tolerance)


def test_the_table_that_the_planner_was_given_is_the_controllers(tmp_path):
    hand, _ = pinch("barrett")
    thing = load_object("cylinder")
    plan_grasps(thing.view, hand, ContactSpec(table=WRONG), starts=6).save(
        tmp_path / "grasps.safetensors"
    )
    grasp = load_grasps(tmp_path / "grasps.safetensors")[0]
    assert_same_plane(grasp.table, WRONG)
    opened = TrialDriver(GraspTrial(hand, grasp, Truth(thing.mesh, thing.parts)), TrialSpec())
    assert_same_plane(opened.reference.table, WRONG.moved(inverse(grasp.obj_from_hand[0].double())))
    assert opened.scene_spec.table_height == float(thing.mesh.bounds[0, 2])


@pytest.mark.parametrize("true", [None, Plane.horizontal(0.0)])
def test_the_told_table_is_read_in_the_reference_while_the_simulators_is_true(true):
    _, grasp = pinch("allegro")
    hand_from_obj = inverse(grasp.obj_from_hand[0])
    found = driver(WRONG, table=true)
    assert_same_plane(found.reference.table, WRONG.moved(hand_from_obj))
    assert found.scene_spec.table_height == pytest.approx(0.0, abs=1e-9)
    assert_same_plane(
        driver(table=true).reference.table, Plane.horizontal(0.0).moved(hand_from_obj)
    )
    with pytest.raises(BadArgument, match="told: expected None, got a table, for a trial without"):
        driver(WRONG, TrialSpec(table=False), table=true)


def test_a_controller_that_was_told_no_table_knows_none():
    hand, grasp = pinch("allegro")
    for meta in ({}, {"table": "none"}):
        trial = GraspTrial(
            hand, dataclasses.replace(grasp, meta=meta), Truth(cylinder(), [cylinder()])
        )
        assert TrialDriver(trial, TrialSpec()).reference.table is None
    with pytest.raises(BadArgument, match="normal X Y Z, offset D"):
        dataclasses.replace(grasp, meta={"table": "oak"}).table
    assert_same_plane(read_plane(WRONG.describe()), WRONG)


def leaves(value):
    """Every tensor and number in a nested dataclass, as text."""
    if dataclasses.is_dataclass(value):
        return [
            x for field in dataclasses.fields(value) for x in leaves(getattr(value, field.name))
        ]
    return [str(value.tolist()) if isinstance(value, torch.Tensor) else str(value)]


@pytest.mark.parametrize("true", [False, True])
def test_no_change_of_the_truth_changes_the_reference(true):
    """Another object at another place on another table, other neighbours, mass and friction: the
    plan is the same.
    """
    box = trimesh.creation.box([0.05, 0.06, 0.3])
    box.apply_translation([0.01, 0.0, 0.14])
    turned = rigid(rotation_from_vector(real([0.0, 0.1, 0.2])), real([0.01, 0.0, 0.0]))
    lower = Plane(WRONG.normal, -0.02) if true else None
    other = TrialSpec(
        mass=2.0, friction=0.1, gravity=3.0, patch=0.01, lift_height=0.05, overlap=0.5
    )
    first = driver(table=Plane.horizontal(0.0) if true else None)
    second = driver(
        None,
        other,
        mesh=box,
        parts=[box],
        error=turned,
        table=lower,
        neighbours=[Neighbour(cylinder((0.2, 0.0)))],
    )
    assert leaves(first.reference) == leaves(second.reference)
    assert first.scene_spec.table_height != second.scene_spec.table_height or true


def mentioned(hint):
    """The classes in an annotation, and in those of the fields of the library's dataclasses."""
    seen = set()
    left = [hint]
    while left:
        here = left.pop()
        rules = [rule for rule in getattr(here, "__metadata__", ()) if isinstance(rule, Taken)]
        if rules:  # the border makes a value of this kind of whatever is given
            left += [rule.kind for rule in rules]
            continue
        left += [x for x in typing.get_args(here) if not isinstance(x, str)]
        if inspect.isclass(here) and here not in seen:
            seen.add(here)
            if here.__module__.startswith("torchgrasp.") and dataclasses.is_dataclass(here):
                left += hints_of(here).values()
    return seen


@functools.cache
def hints_of(thing):
    """The annotations of a function or class, with names that are imported for type checkers alone."""
    scope = {"trimesh": trimesh} | {name: getattr(torchgrasp, name) for name in torchgrasp.__all__}
    modules = [
        __import__(cls.__module__, fromlist=["_"]) for cls in getattr(thing, "__mro__", [thing])
    ]
    for module in modules:
        scope |= vars(module)
        tree = (
            ast.parse(inspect.getsource(module))
            if module.__name__.startswith("torchgrasp")
            else ast.parse("")
        )
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                source = __import__(str(node.module), fromlist=["_"])
                scope |= {
                    x.asname or x.name: getattr(source, x.name)
                    for x in node.names
                    if hasattr(source, x.name)
                }
    return typing.get_type_hints(
        inspect.unwrap(getattr(thing, "__func__", thing)), scope, include_extras=True
    )


TAKERS = (
    *(derive_reference, ClosingReference.from_grasp, plan_grasps),
    *(GraspController.__init__, GraspController.step, GraspController.relook),
)


@pytest.mark.parametrize("taker", TAKERS)
def test_what_plans_and_controls_takes_no_type_that_holds_the_truth(taker):
    found = set().union(*(mentioned(hint) for hint in hints_of(taker).values()))
    assert len(found) > 3 and not found & set(SECRETS)


@pytest.mark.parametrize("value", [ClosingReference, Observation, PointCloud, ContactSpec])
def test_no_input_of_planner_or_controller_has_a_field_that_holds_the_truth(value):
    assert not mentioned(value) & set(SECRETS)


def test_of_an_object_with_its_mesh_the_border_takes_the_view_alone():
    thing = load_object("cylinder")
    other = dataclasses.replace(thing, mesh=trimesh.creation.box([0.1, 0.1, 0.1]))
    assert as_cloud(thing, "cloud") is thing.view and as_cloud(other, "cloud") is thing.view


def test_the_search_for_types_finds_them():
    assert {trimesh.Trimesh, Truth} <= mentioned(GraspTrial)
    assert trimesh.Trimesh in mentioned(typing.Sequence[Body] | None)


def test_no_object_within_a_controller_holds_the_truth():
    controller = GraspController(driver().reference)
    seen = set()
    left = []
    left.append(controller)
    while left:
        here = left.pop()
        if id(here) in seen:
            continue
        seen.add(id(here))
        assert not isinstance(here, SECRETS)
        if isinstance(here, functools.partial):
            left += [*here.args, *here.keywords.values()]
        elif isinstance(here, dict | list | tuple | set):
            left += [*here.values()] if isinstance(here, dict) else [*here]
        elif type(here).__module__.startswith("torchgrasp."):
            left += vars(here).values() if hasattr(here, "__dict__") else []
    assert len(seen) > 50


@pytest.mark.parametrize("package", ["control", "plan", "planner", "ik", "shape", "scene"])
def test_planner_and_controller_import_nothing_of_the_simulation(package):
    for path in (Path(torchgrasp.__file__).parent / package).rglob("*.py"):
        names = [
            x.module or ""
            for x in ast.walk(ast.parse(path.read_text()))
            if isinstance(x, ast.ImportFrom)
        ]
        assert not [
            name for name in names if name.startswith(("torchgrasp.sim", "torchgrasp.evaluation"))
        ], path
