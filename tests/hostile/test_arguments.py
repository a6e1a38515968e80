"""Every public function and value with every wrong argument: `BadArgument` with its name, before
any work.
"""

import dataclasses
import inspect
from typing import Any

import pytest
import torch
from torch.autograd import forward_ad

import torchgrasp
from tests.hostile.arguments import (
    HOSTILE,
    behind,
    checked_things,
    methods_of,
    public,
    required,
    wrong_arguments,
)
from tests.hostile.samples import sample
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Count

MADE_INSIDE = {
    "ActuatedJoints",
    "CollisionSpheres",
    "Completion",
    "Components",
    "Fingertips",
    "Hand",
    "HollowShape",
    "Joint",
    "JointEstimate",
    "KinematicTree",
    "Link",
    "Observations",
    "Outlines",
    "PreparedCloud",
    "FitProgress",
    "SampleFolder",
    "SceneSpec",
    "SelfCollision",
    "Shape",
    "ShapeDerivatives",
    "ShapeGP",
    "Silhouette",
    "StepContacts",
    "SurfaceJet",
    "MeanJet",
    "ClosingTrace",
    "Urdf",
    "Advice",
    "Explanation",
    "Funnel",
    "Losses",
    "Trial",
    "GraspShards",
    "Arm",
}
"""Values that only the library makes, many of them in each step of a loop."""
THINGS = checked_things()


def test_every_public_function_method_and_value_is_behind_the_border():
    open_ones = []
    for name, thing in public().items():
        if inspect.isfunction(thing) and not behind(thing) and inspect.signature(thing).parameters:
            open_ones.append(name)
        elif inspect.isclass(thing):
            if (
                dataclasses.is_dataclass(thing)
                and not behind(thing.__init__)
                and thing.__name__ not in MADE_INSIDE
            ):
                open_ones.append(name)
            open_ones += [
                function.__qualname__
                for _, function in methods_of(thing).values()
                if not behind(function)
            ]
    known = {
        "torchgrasp.app.cli.main",
        "Value.to",
        "ShapeGP.to",
        "Hand.to",  # `to` refuses what torch does
        "Grasps.show",  # `make_sheet`, which it calls, is behind the border
    }
    assert {*open_ones} == known


@pytest.mark.promise("I1")
@pytest.mark.parametrize("kind", [torchgrasp.PointCloud, torchgrasp.ShapeGP])
def test_values_are_moved_or_name_what_is_wrong(kind, tmp_path):
    value = sample(kind, tmp_path)
    for where in HOSTILE:
        try:
            moved = value.to(where)
        except BadArgument as error:
            moved = error
        assert isinstance(moved, kind) or moved.argument == "to", where


@pytest.mark.promise("I1")
@pytest.mark.parametrize("name", sorted(THINGS))
@pytest.mark.filterwarnings("ignore")  # torch warns of some odd layouts
def test_wrong_arguments_are_refused_by_name(name, tmp_path):
    make, annotated = THINGS[name]
    call = make()
    good = required(annotated, call, tmp_path)
    missed = []
    for key, value in wrong_arguments(annotated, call):
        try:
            call(**good | {key: value})
            missed.append(f"{key}={show(value)} was taken")
        except BadArgument as error:
            if not error.argument.startswith(key) or len(str(error)) > 1000:
                missed.append(f"{key}={show(value)}: {error}")
        except Exception as error:
            missed.append(f"{key}={show(value)}: {error!r}"[:300])
    print(*missed, sep="\n")
    assert not missed, len(missed)


def show(value: Any) -> str:
    return f"{type(value).__name__} {value!r}"[:60]


def test_a_method_takes_its_value_by_name():
    shape = torchgrasp.fit_shape(torchgrasp.load_object("jug").view)
    points = shape.cloud.points[:2]
    assert torch.equal(type(shape).normalise(self=shape, points=points), shape.normalise(points))


def dual(function, x):
    with forward_ad.dual_level():
        return function(forward_ad.make_dual(x, x))


@pytest.mark.promise("I7")
@pytest.mark.parametrize(
    ("transform", "found"),
    [
        (lambda f, x: f(x.clone().requires_grad_()), "a gradient"),
        (lambda f, x: torch.func.grad(f)(x), "a gradient"),
        (lambda f, x: torch.func.jacfwd(f)(x), "a gradient"),
        (lambda f, x: torch.vmap(torch.func.grad(f))(x[None]), "a gradient"),
        (lambda f, x: torch.vmap(f)(x[None]), "inside torch.vmap"),
        (dual, "a gradient"),
    ],
)
def test_transformed_tensors_are_refused_where_nothing_is_differentiable(transform, found):
    def margin(points):
        contacts = torchgrasp.Contacts(points, points)
        return torchgrasp.closure_probability(shape, contacts).probability.sum()

    shape = torchgrasp.fit_shape(torchgrasp.load_object("jug").view)
    with pytest.raises(BadArgument, match=f"contacts.points: .*{found}"):
        transform(margin, torch.eye(3)[None])


def test_calls_of_the_library_are_not_checked_again_in_functions_nor_in_generators():
    @checked
    def double(number: Count) -> int:
        return 2 * number

    @checked
    def call(number: Count) -> int:
        return double(-number)

    @checked
    def call_each(number: Count):
        yield from (double(-k) for k in range(1, number + 1))

    assert call(1) == -2
    items = call_each(2)
    assert next(items) == -2
    with pytest.raises(BadArgument, match="number"):
        double(-1)  # between two items the caller's own calls are checked
    assert list(items) == [-4]
    with pytest.raises(BadArgument, match="number"):
        call_each(-1)
