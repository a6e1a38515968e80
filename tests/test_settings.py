"""Public functions give the same bits under every setting of torch that belongs to the caller, or
refuse it by name. Derivatives under these settings: `tests/gradients/test_table.py`.
"""

import contextlib
import copy
import inspect
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.hostile.arguments import checked_things, required
from tests.hostile.samples import hints_of
from tests.hostile.unchanged import digest
from tests.settings import changed, other_settings
from torchgrasp import (
    Contacts,
    ContactSpec,
    certify,
    load_hand,
    load_object,
    plan_grasps,
    stream_grasps,
)
from torchgrasp.control import DragController
from torchgrasp.foundation.base import Value, kept
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.foundation.rules import Count
from torchgrasp.foundation.settings import usual_settings

F32 = torch.float32
HALVES = torch.float16, torch.bfloat16
LONG = (
    "app.report close_hand partial_view plan_contacts plan_scene pull_grasp lift_grasp "
    "explain_empty stream_grasps"
).split()
"""Functions that take long; those that plan do what `plan_grasps` does. Trials hold seconds of a
clock.
"""
THINGS = {
    name: thing
    for name, thing in checked_things().items()
    if not any(long in name for long in LONG)
}
PRECISION = torch.set_float32_matmul_precision
# a call waits so long [s] for another thread
PATIENCE = 60


def single(value: Any) -> Any:
    """Return an argument in single precision, which autocast rounds."""
    if isinstance(value, Tensor):
        return value.to(F32) if value.is_floating_point() else value
    if isinstance(value, dict):
        return {key: single(x) for key, x in value.items()}
    return value.to(F32) if isinstance(value, Value) else value


def outcome(call: Any, given: dict[str, Any], mode: AbstractContextManager[Any]) -> str:
    """Return a digest of a call's result in a mode, or its error; the call finds nothing kept by
    others.
    """
    owner = getattr(call, "__self__", None)
    if isinstance(owner, Value | DragController):  # a controller goes on with each step
        call = getattr(copy.deepcopy(owner), call.__name__)
    given = copy.deepcopy(given)
    try:
        with mode:
            result = call(**given)
            return digest(list(result) if inspect.isgenerator(result) else result)
    except Exception as error:
        return f"{type(error).__name__}: {error}"


@pytest.mark.promise("N10")
@pytest.mark.parametrize("name", sorted(THINGS))
@pytest.mark.filterwarnings("ignore")
def test_a_public_function_has_the_same_bits_under_other_settings(name: str, tmp_path: Path):
    make, annotated = THINGS[name]
    call = make()
    few: dict[str, Any] = {key: 1 for key, hint in hints_of(annotated).items() if hint is Count}
    given = required(annotated, call, tmp_path) | few
    owner = getattr(call, "__self__", None)
    in_single = getattr(single(owner), call.__name__) if isinstance(owner, Value) else call
    for function, arguments in ((in_single, single(given)), (call, given)):
        # first, so that nothing is kept that was made under the usual settings
        found = outcome(function, arguments, other_settings())
        inferred = outcome(function, arguments, torch.inference_mode())
        plain = outcome(function, arguments, contextlib.nullcontext())
        assert found == inferred == plain
        if "Error" not in plain and "Bad" not in plain:  # else it takes double precision alone
            break


@pytest.mark.promise("N10")
def test_a_plan_over_a_table_has_the_same_bits_under_other_settings():
    view = load_object("jug").view
    hand = load_hand("allegro")
    spec = ContactSpec(table=0.0)
    with other_settings():
        found = plan_grasps(view, hand, spec, starts=80)
    plain = plan_grasps(view, hand, spec, starts=80)
    assert (plain.status == Status.OK).any()
    for name in ("joints", "obj_from_hand", "score", "status"):
        assert getattr(found, name).equal(getattr(plain, name))


@pytest.mark.parametrize("dtype", HALVES)
def test_a_default_dtype_of_half_precision_is_refused(dtype: torch.dtype):
    view = load_object("cylinder").view
    hand = load_hand("barrett")
    calls = (
        lambda: certify(Contacts(view.points[None, :3], view.points[None, :3])),
        lambda: load_hand("barrett"),
        lambda: next(stream_grasps(view, hand)),
        ContactSpec,
    )
    with changed(torch.set_default_dtype, dtype, F32):
        for call in calls:
            with pytest.raises(BadArgument, match=f"get_default_dtype.*torch.float32.*{dtype}"):
                call()


@checked
def each(x: Tensor) -> Iterator[Tensor]:
    for _ in range(2):
        yield x @ x


class Square(Value):
    def __init__(self, x: Tensor) -> None:
        self.x = x

    @kept
    def product(self) -> Tensor:
        return self.x @ self.x


def test_items_of_a_generator_and_kept_properties_are_computed_under_the_usual_settings():
    x = torch.randn(8, 8, generator=torch.Generator().manual_seed(0))
    expected = x @ x
    with torch.autocast("cpu"), torch.inference_mode():
        items = [*each(x), Square(x).product]
        assert (x @ x).dtype == torch.bfloat16
    assert all(torch.equal(item, expected) for item in items)
    assert not any(item.is_inference() for item in items)


def test_what_inference_mode_makes_can_be_differentiated_after_it():
    with torch.inference_mode():
        hand = load_hand("barrett").to(F32)
        row = Contacts(torch.eye(3)[None], torch.eye(3)[None])[[0]]
    joints = torch.zeros(1, 4, requires_grad=True)
    hand.fingertips(joints)[0].sum().backward()
    assert joints.grad is not None and bool(joints.grad.any())
    assert not row.points.is_inference() and not row.normals.is_inference()


@pytest.mark.parametrize("precision", ["highest", "high", "medium"])
def test_the_precision_of_products_is_the_callers_again_after_the_last_call(precision: str):
    found = torch.get_float32_matmul_precision
    with changed(PRECISION, precision, "highest"):
        with usual_settings():
            with usual_settings():
                assert found() == "highest"
            assert found() == "highest"
        assert found() == precision


def test_a_thread_that_ends_first_leaves_full_products_to_the_other():
    started = threading.Event()
    ended = threading.Event()
    seen = []

    @checked
    def wait() -> None:
        started.set()
        ended.wait(PATIENCE)
        seen.append(torch.get_float32_matmul_precision())

    with changed(PRECISION, "medium", "highest"):
        thread = threading.Thread(target=wait)
        thread.start()
        started.wait(PATIENCE)
        load_hand("barrett")
        ended.set()
        thread.join()
        assert torch.get_float32_matmul_precision() == "medium"
    assert seen == ["highest"]


def test_precisions_of_single_backends_are_set_back():
    backend = torch.backends.cuda.matmul
    if not hasattr(torch.backends, "fp32_precision"):
        pytest.skip("this torch has one precision for all backends")
    before = backend.fp32_precision
    backend.fp32_precision = "tf32"
    try:
        with usual_settings():
            assert backend.fp32_precision == "ieee"
        assert backend.fp32_precision == "tf32"
    finally:
        backend.fp32_precision = before
