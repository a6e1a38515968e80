"""A second device for tests: CPU tensors that say they are elsewhere, and break where a GPU's
would.

`Elsewhere` behaves like a tensor of `DEVICE`. An operation on tensors of both devices is an error,
as is `numpy()`, a draw there by a generator of the CPU, or an index from there into a tensor of the
CPU. `pretend` makes `device=DEVICE` work. `TRAFFIC` says when a function runs there, and tells what
crosses the border of the devices.
"""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

DEVICE = torch.device("cuda:0")
MAKERS = {
    getattr(torch, name)
    for name in "tensor as_tensor zeros ones full empty eye arange linspace rand randn randint randperm".split()
} | {torch.triu_indices, torch.tril_indices}
"""Functions that make tensors where they are told to."""
DATA = {
    "item",
    "tolist",
    "__bool__",
    "__float__",
    "__int__",
    "__index__",
    "__repr__",
    "__format__",
    "__len__",
}
DATA |= {
    "dim",
    "size",
    "stride",
    "numel",
    "is_contiguous",
    "is_floating_point",
    "data_ptr",
    "backward",
}
"""Functions that return no tensor."""
INTO = {"__getitem__", "__setitem__", "index_put", "index_put_"}
"""Functions that take indices of the CPU, too."""
COPIES = {"tolist", "__repr__", "__format__"}
"""Functions that copy a whole tensor to the host."""
NUMBERS = {torch.Size, torch.dtype, bool, int, float}
"""Types of results without tensors."""
TOLD = {*INTO, "copy_", "new_tensor"}
"""Functions that may copy numbers to the device."""
PLACES = torch.device, str
SERIES = list, tuple
DEVICE_OF = Tensor.device.__get__
IS_CUDA = Tensor.is_cuda.__get__
HOST_ONLY = Tensor.numpy, Tensor.__array__


@dataclasses.dataclass
class Traffic:
    """How many nested functions run on the pretended device, and who is told of an "upload" or a
    "read".
    """

    running: int = 0
    tell: Callable[[str], None] = lambda kind: None


TRAFFIC = Traffic()


class SerialPool:
    """A pool of one thread, the caller's: the pretended device is known there alone."""

    def __init__(self, *arguments: Any) -> None: ...
    def __enter__(self) -> "SerialPool":
        return self

    def __exit__(self, *error: Any) -> None: ...
    def map(self, function: Any, *values: Any) -> Any:
        return map(function, *values)

    def submit(self, function: Any, *values: Any) -> Future:
        future: Future = Future()
        future.set_result(function(*values))
        return future


def elsewhere(value: Tensor) -> Tensor:
    """Return a copy on the pretended device."""
    return value.detach().clone().as_subclass(Elsewhere)


def _home(value: Any) -> Any:
    """Return a device argument as the CPU's, if it names the pretended device."""
    if not isinstance(value, PLACES):
        return value
    return torch.device("cpu") if str(value).split(":")[0] == DEVICE.type else value


def _plain(value: Any) -> Any:
    return value.as_subclass(Tensor) if isinstance(value, Elsewhere) else value


def _moved(value: Any) -> Any:
    """Return every plain tensor of a result as one of the pretended device."""
    if type(value) is Tensor:
        return value.as_subclass(Elsewhere)
    if type(value) in NUMBERS:
        return value
    if isinstance(value, list):
        return [_moved(x) for x in value]
    if isinstance(value, tuple):
        parts = [_moved(x) for x in value]
        return tuple(parts) if type(value) is tuple else type(value)(parts)
    return value


def _tensors(values: Any) -> list[Tensor]:
    """Return the tensors among values, and inside their lists, tuples and dictionaries."""
    found = []
    for value in values:
        if isinstance(value, Tensor):
            found.append(value)
        elif isinstance(value, SERIES):
            found += _tensors(value)
        elif isinstance(value, dict):
            found += _tensors(value.values())
    return found


def _device(value: Tensor) -> torch.device:
    return DEVICE if isinstance(value, Elsewhere) else torch.device("cpu")


def _target(arguments: list[Any]) -> torch.device | None:
    """Return the device that `Tensor.to` is asked for."""
    for value in arguments:
        if isinstance(value, PLACES):
            return torch.device(value)
        if isinstance(value, Tensor):
            return _device(value)
    return None


class Elsewhere(Tensor):
    """A tensor that says it is on `DEVICE`."""

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run a function of tensors as the device would."""
        name = getattr(func, "__name__", "")
        if name == "__get__":
            if func == DEVICE_OF:
                return DEVICE
            if func == IS_CUDA:
                return True
        kwargs = kwargs or {}
        with torch._C.DisableTorchFunctionSubclass():
            if func is Tensor.cpu:
                TRAFFIC.tell("read")
                return _plain(args[0]).clone()
            if func is Tensor.to:
                return _to(args, kwargs)
            if func in HOST_ONLY:
                raise TypeError(f"can't convert {DEVICE} device type tensor to numpy")
            TRAFFIC.running += 1
            try:
                if name == "__get__" or name == "__set__":
                    return _moved(func(*args, **kwargs))
                if name in COPIES:
                    TRAFFIC.tell("read")
                if name in DATA:
                    return func(*args, **kwargs)
                if func is Tensor.__deepcopy__:
                    return elsewhere(args[0])
                # nothing is mixed in most calls
                alike = not kwargs and ALIKE.issuperset(map(type, args))
                if not alike:
                    _refuse_mixes(func, name, args, kwargs)
                if name in TOLD:
                    _tell_uploads(name, args)
                if alike:
                    return _moved(func(*args))
                result = func(*map(_home, args), **(kwargs and _all_home(kwargs)))
            finally:
                TRAFFIC.running -= 1
        stays = kwargs.get("device") is not None and torch.device(kwargs["device"]).type == "cpu"
        return result if stays else _moved(result)


ALIKE = {Elsewhere, *NUMBERS}
"""Types of arguments without a tensor of the CPU."""


@contextlib.contextmanager
def _running() -> Iterator[None]:
    """Count a function that runs on the pretended device."""
    TRAFFIC.running += 1
    try:
        yield
    finally:
        TRAFFIC.running -= 1


def _tell_uploads(name: str, args: Any) -> None:
    """Tell of each argument of the CPU that the device copies: indices, a copied tensor, numbers of
    a new tensor.
    """
    if name in INTO:
        indices = args[1] if isinstance(args[1], tuple) else (args[1],)
        uploads = sum(
            isinstance(x, list) or (isinstance(x, Tensor) and not isinstance(x, Elsewhere))
            for x in indices
        )
    elif name == "copy_":
        if not isinstance(args[0], Elsewhere):
            TRAFFIC.tell("read")
        uploads = isinstance(args[0], Elsewhere) and not isinstance(args[1], Elsewhere)
    else:
        uploads = name == "new_tensor"
    for _ in range(uploads):
        TRAFFIC.tell("upload")


def _all_home(kwargs: dict[str, Any]) -> dict[str, Any]:
    return {key: _home(value) for key, value in kwargs.items()}


def _to(args: Any, kwargs: dict[str, Any]) -> Tensor:
    """Run `Tensor.to`; a move between the devices copies."""
    target = _target([*args[1:], *kwargs.values()]) or _device(args[0])
    if target.type != _device(args[0]).type:
        TRAFFIC.tell("upload" if target.type == DEVICE.type else "read")
        return _convert(target, args, kwargs)
    with _running():
        return _convert(target, args, kwargs)


def _convert(target: torch.device, args: Any, kwargs: dict[str, Any]) -> Tensor:
    """Return the tensor of `Tensor.to` on the device `target`."""
    rest = [_home(_plain(x)) for x in args[1:]]
    result = Tensor.to(
        _plain(args[0]), *rest, **{key: _home(_plain(value)) for key, value in kwargs.items()}
    )
    if target.type != _device(args[0]).type:
        result = result.clone() if result is _plain(args[0]) else result
    elif args[0].dtype == result.dtype:
        return args[0]
    return result.as_subclass(Elsewhere if target.type == DEVICE.type else Tensor)


def _refuse_mixes(func: Any, name: str, args: Any, kwargs: dict[str, Any]) -> None:
    """Raise what a GPU raises for tensors of both devices, except where it takes them."""
    tensors = _tensors([*args, *kwargs.values()])
    there = any(isinstance(x, Elsewhere) for x in tensors)
    generator = kwargs.get("generator")
    if generator is not None and there and generator.device.type == "cpu":
        raise RuntimeError(f"Expected a '{DEVICE.type}' device type for generator but found 'cpu'")
    if not there or not any(not isinstance(x, Elsewhere) and x.dim() > 0 for x in tensors):
        return
    if name == "copy_":
        return
    if name in INTO and isinstance(args[0], Elsewhere):
        values = _tensors(args[2:3])
        if any(not isinstance(x, Elsewhere) and x.dim() > 0 for x in values):
            raise RuntimeError(f"{name}: expected all tensors to be on the same device")
    else:
        raise RuntimeError(
            f"{name}: expected all tensors to be on the same device, but found {DEVICE} and cpu"
        )


class _Makers(TorchFunctionMode):
    """Lets functions that make tensors make them on the pretended device."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run a function that makes or moves a tensor."""
        kwargs = kwargs or {}
        if func is not Tensor.to and func not in MAKERS:
            return func(*args, **kwargs)
        if (
            func in MAKERS
            and kwargs.get("device") is not None
            and torch.device(kwargs["device"]).type == DEVICE.type
        ):
            if kwargs.get("generator") is not None:
                raise RuntimeError(
                    f"Expected a '{DEVICE.type}' device type for generator but found 'cpu'"
                )
            if func in (torch.tensor, torch.as_tensor):
                if not isinstance(args[0], Elsewhere):
                    TRAFFIC.tell("upload")
                return _moved(func(*args, **_all_home(kwargs)))
            with _running():
                return _moved(func(*args, **_all_home(kwargs)))
        if func is Tensor.to and type(args[0]) is Tensor:
            target = _target([*args[1:], *kwargs.values()])
            if target is not None and target.type == DEVICE.type:
                with torch._C.DisableTorchFunctionSubclass():
                    return _to(args, kwargs)
        return func(*args, **kwargs)


@contextlib.contextmanager
def pretend() -> Iterator[None]:
    """Open a context in which the pretended device is known."""
    with mock.patch("torchgrasp.posture_model.sample.ThreadPoolExecutor", SerialPool), _Makers():
        yield
