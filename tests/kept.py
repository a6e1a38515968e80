"""Shapes and posture libraries that one process computes once for all tests.

Only tests whose subject is something else get a kept value; `OWN` are the folders of the others.
Values are frozen, so that no test can change what another one gets.
"""

import dataclasses
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

TESTS = Path(__file__).parent
OWN = ("contacts", "devices", "geometry", "gradients", "hostile", "ik", "laws", "shape")
"""Folders of tests whose subject are the shapes, the libraries, or what a call costs."""

KEPT: dict[Any, Any] = {}
kept_now = False
installed = False


def allow(path: Path) -> None:
    """Tell whether the next test, in this file, may get kept values."""
    global kept_now
    below = path.relative_to(TESTS).parts if path.is_relative_to(TESTS) else ()
    kept_now = bool(below) and below[0] not in OWN
    if kept_now:
        _install()


def _install() -> None:
    """Put the kept values before what computes them; the library is imported late, with its checks."""
    global installed
    if installed:
        return
    installed = True
    from torchgrasp.ik.seeds import PostureLibrary
    from torchgrasp.planner import objects
    from torchgrasp.shape import fit

    fit_upright = fit.fit_upright
    draw = PostureLibrary._drawn

    def shape(cloud: Any, *options: Any) -> Any:
        parts = _parts(cloud)
        if not kept_now or parts is None:
            return fit_upright(cloud, *options)
        key = ("shape", parts, *options)
        if key in KEPT:
            return KEPT[key]
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            found = fit_upright(cloud, *options)
        if not told:
            KEPT[key] = found
            return found
        return fit_upright(cloud, *options)  # a warning is told at each call

    def library(hand: Any, count: int, seed: int) -> Any:
        if not kept_now or type(hand.lower) is not Tensor or hand.lower.device.type != "cpu":
            return draw(hand, count, seed)
        numbers = [(x.dtype, x.numpy().tobytes()) for x in (hand.lower, hand.upper)]
        key = ("library", hand.source, *numbers, count, seed)
        if key not in KEPT:
            KEPT[key] = draw(hand, count, seed)
        return dataclasses.replace(KEPT[key], hand=hand)

    fit.fit_upright = objects.fit_upright = shape
    PostureLibrary._drawn = staticmethod(library)


def _parts(cloud: Any) -> Any:
    """Return all numbers of a cloud as a key; none for tensors that are unlike those of the CPU."""
    found = []
    for field in dataclasses.fields(cloud):
        value = getattr(cloud, field.name)
        if isinstance(value, Tensor):
            plain = type(value) is Tensor and value.device.type == "cpu" and not value.requires_grad
            if not plain or torch._C._functorch.is_functorch_wrapped_tensor(value):
                return None
            value = (value.dtype, tuple(value.shape), value.contiguous().numpy().tobytes())
        elif value is not None and not isinstance(value, int | float | str | bool):
            return None
        found.append(value)
    return tuple(found)
