"""The numbers of a controller that change while it runs: it goes on from them in another process.

Every number that a `Part` keeps is its state, so no field can be forgotten. What a part is given when it is made
(values such as the reference, functions, models) is none.
"""

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.checks import checked
from torchgrasp.errors import BadArgument, Status
from torchgrasp.files import save_tensors
from torchgrasp.value_files import read_value


class Part:
    """A part of a controller: its tensors, arrays and numbers, and those of parts inside it, are its state."""


def numbers_of(part: Part, name: str) -> dict[str, Tensor]:
    """Return copies of a part's state by dotted names that begin with a name."""
    found: dict[str, Tensor] = {}
    for field, value in vars(part).items():
        key = f"{name}.{field}"
        if isinstance(value, Part):
            found |= numbers_of(value, key)
        elif isinstance(value, Tensor | np.ndarray | float | bool | Status):
            exact = torch.float64 if isinstance(value, float) else None
            found[key] = torch.as_tensor(value, dtype=exact).detach().clone()
    return found


def gather(own: dict[str, Any], parts: dict[str, Part]) -> dict[str, Tensor]:
    """Return copies of a controller's own numbers and of the states of its parts, by dotted names."""
    found = {f"controller.{name}": torch.as_tensor(x, dtype=torch.float64).clone() for name, x in own.items()}
    for name, part in parts.items():
        found |= numbers_of(part, name)
    return found


def go_on(part: Part, name: str, numbers: dict[str, Tensor]) -> None:
    """Let a part take over a state of the same layout."""
    for field, value in list(vars(part).items()):
        key = f"{name}.{field}"
        if isinstance(value, Part):
            go_on(value, key, numbers)
        elif key in numbers:
            setattr(part, field, _like(value, numbers[key]))


def _like(value: Any, number: Tensor) -> Any:
    """Return a number in the type that a part keeps it in."""
    if isinstance(value, Tensor):
        return number.clone()
    if isinstance(value, np.ndarray):
        return number.numpy().copy()
    return Status(int(number)) if isinstance(value, Status) else type(value)(number.item())


@checked
@dataclasses.dataclass(frozen=True)
class ControllerState(Value):
    """The state of a `GraspController` at a tick; `load_controller_state` reads what `save` wrote.

    Args:
        numbers: all numbers of its parts, one after the other.
        layout: what they are: the modes of the controller, names and shapes, and the SHA-256 of the numbers.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp(), "state.safetensors")
    >>> ControllerState(torch.zeros(3).double(), "made by GraspController.state").save(file)
    >>> load_controller_state(file).layout
    'made by GraspController.state'
    """

    numbers: Float[Tensor, " n"]
    layout: str

    @checked
    def save(self, path: Path | str) -> None:
        """Write the state as a safetensors file, whole or not at all.

        Raises:
            OutputError: the file cannot be written.
        """
        save_tensors(path, "controller", {"numbers": self.numbers}, {"layout": self.layout})


@checked
def load_controller_state(path: Path | str) -> ControllerState:
    """Read a state that `ControllerState.save` wrote.

    Raises:
        ModelFileError: the file is missing or malformed.

    >>> import tempfile
    >>> from torchgrasp import GraspController, load_hand
    >>> from torchgrasp.control import ClosingReference
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> reference = ClosingReference.from_grasp(load_hand("barrett"), load_shipped_grasp("jug", "barrett"))
    >>> file = Path(tempfile.mkdtemp(), "state.safetensors")
    >>> GraspController(reference).state().save(file)
    >>> GraspController(reference).restore(load_controller_state(file))
    """
    state, meta = read_value(path, "controller", ControllerState, layout="")
    return dataclasses.replace(state, layout=meta.get("layout", ""))


def pack(modes: str, numbers: dict[str, Tensor]) -> ControllerState:
    """Return a state of named numbers: flags and codes are whole, so float64 holds them as they are."""
    flat = torch.cat([x.to(torch.float64).reshape(-1) for x in numbers.values()])
    return ControllerState(flat, _layout(modes, numbers) + _digest(flat))


def unpack(modes: str, numbers: dict[str, Tensor], state: ControllerState) -> dict[str, Tensor] | None:
    """Return the numbers of a state by name, in shape and type of given ones; None if it has another layout.

    Raises:
        BadArgument: numbers that no controller gave: they would move a hand anywhere.
    """
    sizes, flat, layout = [x.numel() for x in numbers.values()], state.numbers.to("cpu", torch.float64), state.layout
    if not layout.startswith(_layout(modes, numbers)) or len(flat) != sum(sizes):
        return None
    if layout != _layout(modes, numbers) + _digest(flat):
        raise BadArgument("state", "numbers that are not those of its digest", "a state that a controller gave")
    parts = flat.split(sizes)
    return {name: x.reshape(like.shape).to(like.dtype) for (name, like), x in zip(numbers.items(), parts, strict=True)}


def _layout(modes: str, numbers: dict[str, Tensor]) -> str:
    """Return modes, names and shapes in one line."""
    return "; ".join([modes, *(f"{name} {list(x.shape)} {x.dtype}" for name, x in numbers.items())])


def _digest(numbers: Float[Tensor, " n"]) -> str:
    """Return the SHA-256 of numbers as the end of a layout."""
    return f"; sha256 {hashlib.sha256(numbers.numpy().tobytes()).hexdigest()}"
