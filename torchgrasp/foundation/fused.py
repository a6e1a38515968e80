"""Compiled loops in the place of many small operations of torch. Each operation takes a microsecond
or more however little it computes.

The operations of torch stay the definition: loops compute the same to 1e-9, and only where no
gradient is needed. The extra `fast` brings numba, which compiles each loop at its first use, and
keeps the result on the disk. Where numba is installed, loops are on unless the environment has
`TORCHGRASP_FUSED=0`.
"""

import functools
import hashlib
import importlib
import importlib.util
import inspect
import logging
import os
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgrasp.foundation.errors import BadArgument, MissingExtra
from torchgrasp.foundation.rules import is_known, is_tracked

VARIABLE = "TORCHGRASP_FUSED"
"""Environment variable: "0" turns compiled loops off, and "1" demands them. Else they are on where
numba is installed.
"""
LEAST_NUMBA = 0, 61
"""Least version of numba; that of the extra `fast`."""
_log = logging.getLogger(__name__)
REORDERED = {"reassoc", "contract", "nsz"}
"""What the compiler may change: the order of sums, so that it can use vector instructions."""


@functools.cache
def has_numba() -> bool:
    """Return whether numba is installed."""
    return importlib.util.find_spec("numba") is not None


@functools.cache
def can_compile() -> bool:
    """Return whether numba can be imported, and is at least version 0.61 (`LEAST_NUMBA`).

    A numba that another package installed may be too old, or unable to work with the installed
    NumPy.
    """
    try:
        numba = importlib.import_module("numba")
    except ImportError:
        return False
    return numba.version_info.short >= LEAST_NUMBA


def is_fused(*tensors: Tensor) -> bool:
    """Return whether loops compiled by numba are on and can compute with all of these tensors. They
    can if every tensor is float64 on the CPU, needs no gradient, and is not inside torch.vmap.

    Raises `MissingExtra` if the environment has TORCHGRASP_FUSED=1, but numba is not installed.
    Raises `BadArgument` for a value of TORCHGRASP_FUSED other than "0", "1" or none.
    """
    return are_on() and all(
        x.dtype == torch.float64 and x.device.type == "cpu" and is_known(x) and not is_tracked(x)
        for x in tensors
    )


def are_on() -> bool:
    """Return whether loops compiled by numba are on.

    They are on if the environment variable TORCHGRASP_FUSED is "1". They are also on if it is unset
    or empty, and numba can compile. Raises `MissingExtra` for "1" without numba, and `BadArgument`
    for values other than "0", "1" or none.
    """
    asked = os.environ.get(VARIABLE, "")
    if asked not in {"", "0", "1"}:
        raise BadArgument(VARIABLE, repr(asked), "0, 1, or no value")
    if asked == "1" and not has_numba():
        raise MissingExtra("numba", "fast", f"{VARIABLE}=1")
    return asked == "1" or (asked == "" and can_compile())


def compiled(function: Any) -> Any:
    """Return a function of NumPy arrays and numbers, compiled by numba to machine code, which is
    cached on the disk.

    Where no cache folder can be written, each process compiles the function anew. The cache does
    not notice a changed constant of a module: pass constants as arguments. Without numba, the
    function itself is returned.
    """
    # numba names files by this, and would miss a change of what the function calls
    digest = hashlib.sha256(_content(inspect.unwrap(function)) + repr(sorted(REORDERED)).encode())
    inspect.unwrap(function).__qualname__ += f"_{digest.hexdigest()[:8]}"
    try:
        return _compile(function, cache=True)
    except RuntimeError:  # no folder
        return _compile(function)


def inlined(function: Any) -> Any:
    """Return a function that only `compiled` functions call, and into which numba inlines it. With
    numba, Python itself cannot call it. Without numba, the function itself is returned.
    """
    # a call would find one of several copies, of other bits in a process that has just compiled
    options = dict(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
    return _compile(function, **options)


def _compile(function: Any, **options: Any) -> Any:
    """Return the function itself without numba: the same loops, but slow."""
    # checks of annotations, as tests add them, can not be compiled
    plain = inspect.unwrap(function)
    try:
        import numba  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        return plain
    _tell_of_compilation()
    return numba.njit(error_model="numpy", fastmath=REORDERED, **options)(plain)


@functools.cache
def _tell_of_compilation() -> None:
    """Log one line when numba begins to compile loops of the library: it takes up to a minute.

    Machine code that is found on the disk is loaded without a word.
    """
    events = importlib.import_module("numba.core.event")

    class Listener(events.Listener):
        """Hears of each function that numba begins to compile."""

        def __init__(self) -> None:
            self.told = False

        def on_start(self, event: Any) -> None:
            # numba itself generates functions that are of no module
            module = event.data["dispatcher"].py_func.__module__ or ""
            if not self.told and module.startswith("torchgrasp."):
                self.told = True
                _log.warning("compiling loops, once on this machine; it takes up to a minute")

        def on_end(self, event: Any) -> None:
            """Do nothing."""

    events.register("numba:compile", Listener())


def _content(function: Any) -> bytes:
    """Return the bytecode of a function and of all inlined ones that it calls."""
    code = function.__code__
    called = [function.__globals__.get(name) for name in code.co_names]
    own = code.co_code + repr((code.co_consts, code.co_names)).encode()
    return own + b"".join(_content(x.py_func) for x in called if hasattr(x, "py_func"))


def array(x: Tensor, dtype: torch.dtype = torch.float64) -> np.ndarray:
    """Return the tensor `x`, which is on the CPU, as a contiguous NumPy array of the type `dtype`.
    The array shares the tensor's memory if possible.
    """
    x = x.detach() if x.requires_grad else x
    return np.ascontiguousarray(x.to(dtype).numpy())
