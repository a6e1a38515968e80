"""Values and tensors with metadata as a safetensors file, which is checked when it is read."""

import dataclasses
import functools
import json
import typing
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import jaxtyped
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.checks import is_tensor
from torchgrasp.errors import ModelFileError
from torchgrasp.files.write import check_file, write_file
from torchgrasp.limits import LARGEST_NUMBER, TENSOR_FILE_BYTES

Item = TypeVar("Item")
SomeValue = TypeVar("SomeValue", bound=Value)

VERSION = "1"  # version of the file layout; readers refuse all others

DTYPES = (torch.float32, torch.float64, torch.int64, torch.bool)  # dtypes in our files


def save_tensors(path: Path | str, kind: str, tensors: dict[str, Tensor], meta: dict[str, str]) -> Path:
    """Write tensors and metadata as one safetensors file of a `kind`; raise `OutputError` if this fails."""
    # as bytes, since a full disk then is an OSError, which save_file makes an error of its own
    return write_file(path, pack_tensors(kind, tensors, meta))


def pack_tensors(kind: str, tensors: dict[str, Tensor], meta: dict[str, str]) -> bytes:
    """Return the bytes of a safetensors file of a `kind`; equal tensors and metadata give equal bytes."""
    contiguous = {name: t.detach().cpu().contiguous().clone() for name, t in tensors.items()}  # a file shares no memory
    # One JSON string: safetensors writes several metadata keys in random order, and equal values must give equal bytes.
    header = {"torchgrasp": json.dumps({**meta, "kind": kind, "version": VERSION}, sort_keys=True)}
    return save(contiguous, header)


def load_tensors(
    path: Path | str, kind: str, names: set[str], optional: Collection[str] = ()
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read a safetensors file with tensors `names` and any of `optional`; raise `ModelFileError` for other files."""
    allowed = names.union(optional)
    refuse = functools.partial(ModelFileError, "path")
    check_file(path, TENSOR_FILE_BYTES, f"a safetensors file of kind {kind!r}", refuse)
    try:
        with safe_open(path, framework="pt") as file:
            meta = json.loads((file.metadata() or {}).get("torchgrasp", "{}"))
            found = set(file.keys())
            # The others stay unread. A copy is aligned as what was saved: unaligned numbers round otherwise.
            tensors = {name: file.get_tensor(name).clone() for name in found & allowed}
    except (SafetensorError, OSError, ValueError, KeyError, RecursionError) as error:
        raise refuse(f"{path}: {error}", f"a safetensors file of kind {kind!r}") from error
    if not isinstance(meta, dict) or not all(isinstance(x, str) for x in meta.values()):
        raise refuse(f"{path}: metadata that is no object of texts", f"kind {kind!r}")
    if meta.get("kind") != kind or meta.get("version") != VERSION:
        other = f"kind {meta.get('kind')!r}, version {meta.get('version')!r}"
        raise refuse(f"{path}: {other}", f"kind {kind!r}, version {VERSION!r}")
    if not names <= found <= allowed:
        raise refuse(f"{path}: tensors {sorted(found)}", f"tensors {sorted(names)}")
    for name, t in tensors.items():
        if t.dtype not in DTYPES:
            raise refuse(f"{path}: {name} of {t.dtype}", f"one of {', '.join(map(str, DTYPES))}")
        if t.is_floating_point() and not bool((t.abs() <= LARGEST_NUMBER).all()):
            found = f"{path}: a number beyond {LARGEST_NUMBER:g} or a non-finite number in {name}"
            raise refuse(found, "finite numbers")
    return tensors, meta


def read_value(path: Path | str, kind: str, of: type[SomeValue], **rest: Any) -> tuple[SomeValue, dict[str, str]]:
    """Read a value and metadata from a safetensors file of a `kind`; raise `ModelFileError` for other shapes or types.

    The annotations of the fields name the tensors. `rest` gives fields that are no tensors; others keep their defaults.
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
    """Return the annotations of all tensors in a value class by dotted name; optional tensors include NoneType."""
    fields: dict[str, tuple[Any, ...]] = {}
    for name, hint in _hints(of).items():
        kinds = typing.get_args(hint) if typing.get_origin(hint) not in (None, dict) else (hint,)
        if _is_value(hint):
            fields |= _tensor_fields(hint, f"{prefix}{name}.")
        elif is_tensor(kinds[0]):
            fields[prefix + name] = kinds
    return fields


def _build(of: type[SomeValue], tensors: dict[str, Tensor], prefix: str, rest: dict[str, Any]) -> SomeValue:
    """Return a value built from tensors by dotted name; a missing tensor becomes None."""
    values: dict[str, Any] = dict(rest)
    own = _tensor_fields(of)
    for name, hint in _hints(of).items():
        if _is_value(hint):
            values[name] = _build(hint, tensors, f"{prefix}{name}.", {})
        elif name in own and name not in rest:
            values[name] = tensors.get(prefix + name)
    return of(**values)


def _hints(of: type[Value]) -> dict[str, Any]:
    hints = typing.get_type_hints(of)
    return {field.name: hints[field.name] for field in dataclasses.fields(of)}  # pyright: ignore[reportArgumentType]


def _is_value(hint: Any) -> bool:
    return typing.get_origin(hint) is None and isinstance(hint, type) and issubclass(hint, Value)


class Recent(Generic[Item]):
    """A cache of the last few items read, by number; a copy in another process starts empty."""

    def __init__(self, most: int) -> None:
        self.most = most
        self.kept: dict[int, Item] = {}

    def get(self, number: int, read: Callable[[int], Item]) -> Item:
        """Return an item by number; read it if it is not in the cache."""
        item = self.kept.pop(number, None)
        item = read(number) if item is None else item
        self.kept[number] = item  # now the last one
        for oldest in list(self.kept)[: -self.most]:
            self.kept.pop(oldest, None)
        return item

    def __reduce__(self) -> tuple[Any, ...]:
        return Recent, (self.most,)
