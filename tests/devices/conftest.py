"""What the tests of devices share: the pretended device, and one planned object."""

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.devices.elsewhere import DEVICE, Elsewhere, pretend
from torchgrasp import (
    ContactSpec,
    Grasps,
    Hand,
    ShapeGP,
    fit_shape,
    load_hand,
    load_object,
    plan_grasps,
)
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.fused import VARIABLE


@pytest.fixture(scope="package", autouse=True)
def operations_of_torch():
    """Compiled loops round in another way than the operations of torch, which a device uses."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(VARIABLE, "0")
        yield


@pytest.fixture
def device():
    with pretend():
        yield


def sent(value: Any) -> Any:
    """Return a value, or parts of one, on the pretended device."""
    if isinstance(value, Value | Tensor):
        return value.to(DEVICE)
    return type(value)(map(sent, value)) if isinstance(value, tuple | list) else value


def at_home(function: Callable[[], Any]) -> Any:
    """Return what a function computes on the CPU alone, as fast as without the pretended device."""
    with torch._C.DisableTorchFunction():
        return function()


def tensors_of(value: Any) -> list[Tensor]:
    if isinstance(value, Tensor):
        return [value]
    if isinstance(value, Value):
        value = tuple(getattr(value, field.name) for field in dataclasses.fields(value))
    return (
        [x for part in value for x in tensors_of(part)] if isinstance(value, tuple | list) else []
    )


def same(there: Any, here: Any, device: torch.device = DEVICE) -> None:
    """Assert that a result is on a device, and has the numbers and types of the CPU's."""
    one = tensors_of(there)
    other = tensors_of(here)
    assert len(one) == len(other) > 0
    for a, b in zip(one, other, strict=True):
        assert a.device == device and a.dtype == b.dtype
        torch.testing.assert_close(a.as_subclass(Tensor), b, rtol=1e-6, atol=1e-8, equal_nan=True)


@pytest.fixture(scope="session")
def shape() -> ShapeGP:
    return fit_shape(load_object("cylinder").view, table=0.0)


@pytest.fixture(scope="session")
def hand() -> Hand:
    return load_hand("barrett")


@pytest.fixture(scope="session")
def grasps(hand: Hand) -> Grasps:
    found = plan_grasps(load_object("cylinder").view, hand, ContactSpec(table=0.0), starts=12)
    assert len(found[found.status == 0]) > 1
    return found[found.status == 0][:2]


__all__ = ["DEVICE", "Elsewhere", "same", "sent"]
