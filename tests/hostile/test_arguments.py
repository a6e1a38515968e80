"""Every public function and value with every wrong argument: `BadArgument` with its name, before any work."""

import dataclasses
import inspect
import typing
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.hostile.arguments import (
    HOSTILE,
    broken,
    crooked,
    hints_of,
    is_wrong,
    public,
    sample,
    sample_tensor,
    spoilt,
    tensors_in,
)
from torchgrasp.border import ANY, RIGID
from torchgrasp.errors import BadArgument

MADE_INSIDE = {
    "ActuatedJoints", "CollisionSpheres", "Completion", "Components", "Fingertips", "Hand", "HollowShape", "Joint",
    "JointEstimate", "KinematicTree", "Link", "Normalisation", "Observations", "Outlines", "PreparedCloud", "Progress",
    "SampleFolder", "SceneSpec", "SelfCollision", "Shape", "ShapeDerivatives", "ShapeGP", "Silhouette", "StepContacts",
    "SurfaceJet", "MeanJet", "ClosingTrace", "ControlLog", "Urdf", "Advice", "Explanation", "Funnel", "Losses", "Trial",
    "GraspShards",
}  # fmt: skip
"""Values that only the library makes, many of them in each step of a loop."""


NO_PATHS = ["a" * 5000, "b" * 256, "c/" * 2500, "a\0b", "\ud800"]
"""Texts that no file can be called; as paths, too, they are refused the same way."""
NO_PATHS += [Path(text) for text in NO_PATHS]
NO_NUMBERS = "meta", "sparse", "negative bit", "half", "bfloat16"
"""Tensors that no annotation forbids, and the library does."""


def behind(thing: Any) -> bool:
    return hasattr(thing, "__border__")


def checked_things() -> dict[str, tuple[Callable[[], Any], Any]]:
    """Return what gives each function, value and method of a value to call, and what has its annotations, by name."""
    found: dict[str, tuple[Callable[[], Any], Any]] = {}
    for name, thing in public().items():
        if inspect.isfunction(thing) and behind(thing):
            found[name] = partial(_itself, thing), thing
        elif inspect.isclass(thing):
            if behind(thing.__init__) and dataclasses.is_dataclass(thing):
                found[name] = partial(_itself, thing), thing
            for key, method in vars(thing).items():
                inner = method.__func__ if isinstance(method, classmethod | staticmethod) else method
                if inspect.isfunction(inner) and behind(inner) and not key.startswith("_"):
                    still = isinstance(method, classmethod | staticmethod)
                    found[f"{name}.{key}"] = partial(_method, thing, key, still), inner
    return found


def _itself(thing: Any) -> Any:
    return thing


def _method(thing: type, key: str, still: bool) -> Any:
    return getattr(thing if still else sample(thing, Path("x")), key)


THINGS = checked_things()


def test_every_public_function_and_value_is_behind_the_border():
    open_ones = []
    for name, thing in public().items():
        if inspect.isfunction(thing) and not behind(thing) and inspect.signature(thing).parameters:
            open_ones.append(name)
        elif inspect.isclass(thing) and dataclasses.is_dataclass(thing):
            if not behind(thing.__init__) and thing.__name__ not in MADE_INSIDE:
                open_ones.append(name)
    assert open_ones == ["torchgrasp.cli.main"]


@pytest.mark.promise("I1")
@pytest.mark.parametrize("name", sorted(THINGS))
@pytest.mark.filterwarnings("ignore")  # torch warns of some odd layouts
def test_wrong_arguments_are_refused_by_name(name, tmp_path):
    make, annotated = THINGS[name]
    call = make()
    hints, parameters = hints_of(annotated), inspect.signature(call).parameters
    required = {
        key: sample(hints[key], tmp_path)
        for key, p in parameters.items()
        if p.default is p.empty and p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)
    }
    missed = []
    for key, parameter in parameters.items():
        if key not in hints or parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
            continue
        for value in wrong_values(hints[key]):
            try:
                call(**required | {key: value})
                missed.append(f"{key}={show(value)} was taken")
            except BadArgument as error:
                if not error.argument.startswith(key) or len(str(error)) > 1000:
                    missed.append(f"{key}={show(value)}: {error}")
            except Exception as error:
                missed.append(f"{key}={show(value)}: {error!r}"[:300])
    print(*missed, sep="\n")
    assert not missed, len(missed)


def wrong_values(hint: Any) -> list[Any]:
    values = [value for value in HOSTILE if is_wrong(value, hint)]
    if Path in (hint, *typing.get_args(hint)):
        values += NO_PATHS
    for tensor in tensors_in(hint):
        bare = getattr(tensor, "__origin__", tensor)
        valid = sample_tensor(bare)
        values += [value for how, value in broken(valid).items() if how in NO_NUMBERS or is_wrong(value, hint)]
        if getattr(tensor, "__metadata__", ())[:1] == (RIGID,):
            values += crooked(valid)
        if getattr(tensor, "__metadata__", ())[:1] != (ANY,):
            values += spoilt(valid).values()
    return values


def show(value: Any) -> str:
    return f"{type(value).__name__} {value!r}"[:60]
