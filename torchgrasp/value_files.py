"""Values as safetensors files: a tensor for each field, by its dotted name, of the shape that the field declares."""

import dataclasses
import typing
from pathlib import Path
from typing import Any, TypeVar

from jaxtyping import AbstractArray, jaxtyped
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.errors import ModelFileError
from torchgrasp.files import load_tensors

SomeValue = TypeVar("SomeValue", bound=Value)


def read_value(path: Path | str, kind: str, of: type[SomeValue], **rest: Any) -> tuple[SomeValue, dict[str, str]]:
    """Read a value that `save_tensors` wrote under the names of its fields, and the metadata.

    The annotations of its fields say which tensors there are, which may be missing, and their shapes. A letter in them
    has one size in all fields.

    Args:
        path: of the file.
        kind: of the file, such as "grasps".
        of: class of the value.
        rest: fields that are no tensors; others keep their defaults.

    Raises:
        ModelFileError: a file as in `load_tensors`, or a tensor of another shape or type.
    """
    fields = _tensor_fields(of)
    optional = {name for name, kinds in fields.items() if type(None) in kinds}
    tensors, meta = load_tensors(path, kind, set(fields) - optional, optional)
    with jaxtyped("context"):  # binds the letters of the annotations
        for name, tensor in tensors.items():
            if not isinstance(tensor, fields[name][0]):
                found = f"{path}: {name} of shape {tuple(tensor.shape)} and {tensor.dtype}"
                raise ModelFileError("path", found, f"{fields[name][0]}, and one size for each letter")
    return _build(of, tensors, "", rest), {k: v for k, v in meta.items() if k not in ("kind", "version")}


def _tensor_fields(of: type[Value], prefix: str = "") -> dict[str, tuple[Any, ...]]:
    """Return the annotation of each tensor inside a value by its dotted name; with NoneType if it may be missing."""
    fields: dict[str, tuple[Any, ...]] = {}
    for name, hint in _hints(of).items():
        kinds = typing.get_args(hint) if typing.get_origin(hint) not in (None, dict) else (hint,)
        if isinstance(hint, type) and typing.get_origin(hint) is None and issubclass(hint, Value):
            fields |= _tensor_fields(hint, f"{prefix}{name}.")
        elif isinstance(kinds[0], type) and typing.get_origin(kinds[0]) is None and issubclass(kinds[0], AbstractArray):
            fields[prefix + name] = kinds
    return fields


def _build(of: type[SomeValue], tensors: dict[str, Tensor], prefix: str, rest: dict[str, Any]) -> SomeValue:
    """Return a value of tensors by dotted name; a missing one is None."""
    values: dict[str, Any] = dict(rest)
    own = _tensor_fields(of)
    for name, hint in _hints(of).items():
        if isinstance(hint, type) and typing.get_origin(hint) is None and issubclass(hint, Value):
            values[name] = _build(hint, tensors, f"{prefix}{name}.", {})
        elif name in own and name not in rest:
            values[name] = tensors.get(prefix + name)
    return of(**values)


def _hints(of: type[Value]) -> dict[str, Any]:
    """Return the types of a dataclass's fields."""
    hints = typing.get_type_hints(of)
    return {field.name: hints[field.name] for field in dataclasses.fields(of)}  # pyright: ignore[reportArgumentType]
