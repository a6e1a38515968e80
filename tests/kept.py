"""Supports, estimated shapes, posture libraries and plans that tests with another subject compute once.

Tests ask for supports, shapes and libraries by the fixture `kept`, and for plans, too, by `kept_plans`. Those
of shapes, libraries, plans, costs, and of the same numbers in every call, do not.
"""

import dataclasses
import functools
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

KEPT: dict[Any, Any] = {}
"""What a function returned, by its name and the content of its arguments."""


def content(value: Any) -> Any:
    """Return all numbers of a value as a key; raise `TypeError` if it holds what is none."""
    if isinstance(value, Tensor):
        plain = type(value) is Tensor and value.device.type == "cpu" and not value.requires_grad
        if not plain or torch._C._functorch.is_functorch_wrapped_tensor(value):
            raise TypeError
        return value.dtype, tuple(value.shape), value.contiguous().numpy().tobytes()
    if dataclasses.is_dataclass(value):
        fields = (getattr(value, field.name) for field in dataclasses.fields(value) if field.init)
        return type(value), *map(content, fields)
    if isinstance(value, dict):
        return tuple((key, content(one)) for key, one in value.items())
    if isinstance(value, tuple | list):
        return tuple(map(content, value))
    hash(value)
    return value


def once(key: Any, compute: Callable[[], Any]) -> Any:
    """Return what was computed for a key, or compute it; its warnings are told at each call."""
    if key not in KEPT:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            found = compute()
        KEPT[key] = found, told
    found, told = KEPT[key]
    for one in told:
        warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    return found


@pytest.fixture(scope="module")
def kept() -> Iterator[None]:
    """Find the supports of each cloud, estimate the shape of each object, and draw the library of
    each hand, once for all tests.
    """
    from torchgrasp.foundation.errors import NoSupport
    from torchgrasp.geometry import support_search
    from torchgrasp.ik import seeds
    from torchgrasp.planner.objects import ShapedObject

    shaped = ShapedObject.of
    draw = seeds.PostureLibrary._drawn
    find = support_search.find_supports

    def supports(*arguments: Any, **options: Any) -> Any:
        def compute() -> Any:
            try:
                return find(*arguments, **options)
            except NoSupport as error:
                return error

        try:
            found = once(("supports", content(arguments), content(options)), compute)
        except TypeError:
            return find(*arguments, **options)
        if isinstance(found, NoSupport):
            raise found.with_traceback(None)
        return found

    def shape(request: Any) -> Any:
        compute = functools.partial(shaped, request)
        if request.shape is not None:
            return compute()
        try:
            cloud = content(request.cloud)
            table = content(request.contact_spec.table)
        except TypeError:
            return compute()
        return once(("shape", cloud, table, request.seed, request.mode == "paper"), compute)

    def library(hand: Any, count: int, seed: int) -> Any:
        compute = functools.partial(draw, hand, count, seed)
        try:
            key = "library", content(hand), count, seed
        except TypeError:
            return compute()
        return dataclasses.replace(once(key, compute), hand=hand)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ShapedObject, "of", shape)
        patch.setattr(seeds.PostureLibrary, "_drawn", library)
        for module in ("geometry.support_search", "cloud.parts", "cloud.viewpoint"):
            patch.setattr(f"torchgrasp.{module}.find_supports", supports)
        yield


@pytest.fixture(autouse=True)
def examples_once(request: pytest.FixtureRequest) -> None:
    """Do so in the examples of docstrings."""
    if isinstance(request.node, pytest.DoctestItem):
        request.getfixturevalue("kept")


@pytest.fixture(scope="module")
def kept_plans(kept: None) -> Iterator[None]:
    """Plan for each request once; an observer hears the stages of the first plan."""
    from torchgrasp.planner import grasps
    from torchgrasp.planner.request import Request

    plan = grasps.plan_request

    def planned(request: Request) -> Any:
        stages = list[tuple[Any, ...]]()

        def note(*stage: Any) -> None:
            stages.append(stage)
            request.tell(*stage)

        if request.time_budget is not None:
            return plan(request)
        try:
            key = "plan", content(dataclasses.replace(request, observer=None))
        except TypeError:
            return plan(request)
        first = key not in KEPT
        found, told = once(key, lambda: (plan(dataclasses.replace(request, observer=note)), stages))
        for stage in () if first else told:
            request.tell(*stage)
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(grasps, "plan_request", planned)
        yield
