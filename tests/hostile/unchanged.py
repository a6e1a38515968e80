"""What a public call must leave as it was: its arguments, and the state of the process."""

import gc
import hashlib
import locale
import logging
import os
import pickle
import random
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor


def global_state() -> dict[str, Any]:
    """Return the state that all code of a process shares, by name; none of it is changed by
    looking.
    """
    mask = os.umask(0)
    os.umask(mask)
    return {
        "dtype": torch.get_default_dtype(),
        "device": torch.get_default_device(),
        "generator of torch": digest(torch.get_rng_state()),
        "generator of NumPy": digest(list(np.random.get_state())),  # noqa: NPY002
        "generator of Python": random.getstate(),
        "gradients": (
            torch.is_grad_enabled(),
            torch.is_inference_mode_enabled(),
            torch.is_anomaly_enabled(),
        ),
        "threads of torch": (torch.get_num_threads(), torch.get_num_interop_threads()),
        "determinism": (
            torch.are_deterministic_algorithms_enabled(),
            torch.is_deterministic_algorithms_warn_only_enabled(),
            torch.backends.cudnn.deterministic,
            torch.backends.cudnn.benchmark,
            torch.get_float32_matmul_precision(),
        ),
        "numpy.errstate": tuple(np.geterr().items()),
        "numpy.printoptions": repr(np.get_printoptions()),
        "warnings.filters": tuple(warnings.filters),
        "os.environ": dict(os.environ),
        "cwd": os.getcwd(),
        "locale": locale.setlocale(locale.LC_ALL),
        "umask": mask,
        "handlers of signals": [signal.getsignal(s) for s in sorted(signal.valid_signals())],
        "logging": (list(logging.root.handlers), logging.root.level),
        "gc": (gc.isenabled(), gc.get_threshold()),
        "sys.path": list(sys.path),
        "recursion limit": sys.getrecursionlimit(),
        "hooks": (sys.excepthook, threading.excepthook, sys.gettrace(), sys.getprofile()),
        "streams": (sys.stdin, sys.stdout, sys.stderr),
    }


def digest(value: Any) -> str:
    """Return a hash of all numbers and texts in a value, of its tensors bit for bit.

    What is cached counts as no part of a value, nor do streams and functions.
    """
    found = hashlib.sha256()
    for part in _parts(value, ()):
        found.update(part)
    return found.hexdigest()


def _parts(value: Any, above: tuple[int, ...]) -> Iterator[bytes]:
    yield type(value).__name__.encode()
    inner: list[Any] = []
    if id(value) in above:
        return
    if isinstance(value, Tensor):
        yield f"{value.shape} {value.dtype} {value.device} {value.requires_grad} {value._version}".encode()
        if value.layout is torch.strided and not value.is_meta and not value.is_quantized:
            yield (
                value.detach()
                .resolve_neg()
                .contiguous()
                .reshape(-1)
                .view(torch.uint8)
                .numpy()
                .tobytes()
            )
    elif isinstance(value, torch.Generator):
        yield value.get_state().numpy().tobytes()
    elif isinstance(value, np.ndarray):
        yield f"{value.shape} {value.dtype}".encode()
        yield pickle.dumps(value.tolist()) if value.dtype.hasobject else value.tobytes()
    elif isinstance(value, dict):
        inner = [x for pair in value.items() for x in pair]
    elif isinstance(value, list | tuple):
        inner = list(value)
    elif isinstance(value, set | frozenset):
        inner = sorted(value, key=repr)
    elif is_dataclass(value) and not isinstance(value, type):
        inner = [getattr(value, field.name) for field in fields(value) if field.compare]
    elif value is None or isinstance(value, str | bytes | int | float | complex):
        yield repr(value).encode(errors="surrogatepass")
    elif hasattr(value, "vertices") and hasattr(value, "faces"):  # a mesh
        inner = [np.asarray(value.vertices), np.asarray(value.faces)]
    for part in inner:
        yield from _parts(part, (*above, id(value)))


def changes(call: Callable[[], object], *arguments: Any) -> list[str]:
    """Return what a call changed of the global state and of its arguments, whatever it returned or
    raised.
    """
    before = global_state()
    was = [digest(x) for x in arguments]
    try:
        call()
    except Exception:  # what may be raised is another test's
        pass
    after = global_state()
    changed = [name for name in before if before[name] != after[name]]
    return changed + [f"argument {i}" for i, x in enumerate(arguments) if digest(x) != was[i]]
