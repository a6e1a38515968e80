"""Settings of torch that belong to the caller: public calls leave them while they compute.

Inside `torch.autocast`, fingertips are tenths of a millimetre off, and the same seed gives another
plan. The same holds for products of matrices in TensorFloat-32 or bfloat16. What is made in
inference mode can not be differentiated later. A default device would move tensors that the library
makes, such as random draws.
"""

import contextlib
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import Any

import torch

from torchgrasp.foundation.errors import BadArgument

# torch 2.6 raises an error where there is no accelerator
_accelerator = torch.accelerator.current_accelerator() if torch.accelerator.is_available() else None
DEVICES = ("cpu",) if _accelerator is None else ("cpu", _accelerator.type)
"""Types of devices whose tensors autocast may round."""
HIGHEST = "highest"  # torch's name of products of matrices in full float32
UNSET = "none"  # a backend follows the setting of all
_lock = threading.Lock()
_state: dict[str, Any] = {"calls": 0, "products": None, "backends": []}
"""How many calls have set full products, and the settings before the first of them."""


def in_autocast() -> bool:
    """Return whether `torch.autocast` is on in this thread, for any device. Torch may then round
    numbers to a smaller dtype.
    """
    return any(map(torch.is_autocast_enabled, DEVICES))


def usual_settings() -> AbstractContextManager[None]:
    """Return a context in which torch computes in full precision, without autocast and inference
    mode. Within it, new tensors are on the CPU where no device is named.

    If the caller is in inference mode, gradients are off in the context. All settings belong to the
    thread, except the precision of matrix products. That belongs to the process: the last thread to
    leave the context restores it. Raises `BadArgument` if the default dtype is neither float32 nor
    float64.
    """
    # the library names its dtypes; single numbers would be rounded to half precision all the same
    if torch.get_default_dtype() not in (torch.float32, torch.float64):
        raise BadArgument(
            "torch.get_default_dtype()",
            str(torch.get_default_dtype()),
            "torch.float32 or torch.float64: `torch.set_default_dtype` changes it",
        )
    changed = torch.is_inference_mode_enabled() or in_autocast() or _is_elsewhere() or _rounds()
    return _usual() if changed else contextlib.nullcontext()


@contextlib.contextmanager
def _usual() -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        if torch.is_inference_mode_enabled():
            stack.enter_context(torch.inference_mode(False))
            stack.enter_context(torch.no_grad())
        for device in filter(torch.is_autocast_enabled, DEVICES):
            stack.enter_context(torch.autocast(device, enabled=False))
        if _is_elsewhere():
            stack.enter_context(torch.device("cpu"))
        if _rounds():
            stack.enter_context(_full_products())
        yield


def _is_elsewhere() -> bool:
    """Return whether tensors are made on another device than the CPU where none is named."""
    # without a mode there is no default device, which takes long to ask for
    modes = torch._C._len_torch_function_stack()  # pyright: ignore[reportAttributeAccessIssue]
    return bool(modes) and torch.get_default_device().type != "cpu"


def _rounds() -> bool:
    """Return whether products of matrices may be rounded, now or when another call has ended."""
    return bool(_state["calls"]) or _products() != HIGHEST


@contextlib.contextmanager
def _full_products() -> Iterator[None]:
    with _lock:
        if not _state["calls"]:
            _state["products"] = _products()
            _state["backends"] = [part.fp32_precision for part in _backends()]
            torch.set_float32_matmul_precision(HIGHEST)
        _state["calls"] += 1
    try:
        yield
    finally:
        with _lock:
            _state["calls"] -= 1
            if not _state["calls"]:
                _restore_products()


def _products() -> str | None:
    """Return torch's precision of products; None if backends differ, which torch reports as an
    error.
    """
    try:
        return torch.get_float32_matmul_precision()
    except RuntimeError:
        return None


def _backends() -> tuple[Any, ...]:
    """Return the backends that have a precision of their own; older versions of torch have none."""
    if not hasattr(torch.backends, "fp32_precision"):
        return ()
    return torch.backends.cuda.matmul, torch.backends.mkldnn.matmul  # pyright: ignore


def _restore_products() -> None:
    """Set back the precision of products and of each backend, unset where it follows another."""
    if _state["products"] is not None:
        torch.set_float32_matmul_precision(_state["products"])
    for part, value in zip(_backends(), _state["backends"], strict=True):
        if part.fp32_precision != value:
            part.fp32_precision = UNSET
        if part.fp32_precision != value:
            part.fp32_precision = value
