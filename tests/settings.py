"""Settings of torch that belong to the caller, for tests that nothing depends on them."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import torch


@contextlib.contextmanager
def changed(set_to: Callable[[Any], None], value: Any, before: Any) -> Iterator[None]:
    """Give a setting of torch another value within the context."""
    set_to(value)
    try:
        yield
    finally:
        set_to(before)


@contextlib.contextmanager
def other_settings() -> Iterator[None]:
    """Change all settings that change numbers or devices, but inference mode."""
    with (
        torch.autocast("cpu", dtype=torch.bfloat16),
        torch.device("meta"),
        changed(torch.set_float32_matmul_precision, "medium", "highest"),
        changed(torch.use_deterministic_algorithms, True, False),
        changed(torch.set_default_dtype, torch.float64, torch.float32),
    ):
        yield
