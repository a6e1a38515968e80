"""Values in files: JSON and TOML field by field, tensors with metadata as safetensors; both are
checked when read.

An error names the file and the field, such as `objects.cup.views.front`.
"""

import dataclasses
import functools
import json
import sys
import typing
from collections import Counter
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import torch
from jaxtyping import jaxtyped
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from torchgrasp.files.write import Refuse, check_file, read_bounded, write_file
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.errors import BadArgument, ModelFileError
from torchgrasp.foundation.limits import (
    JSON_BYTES,
    JSON_LETTERS,
    LARGEST_NUMBER,
    SHOWN_LETTERS,
    TENSOR_FILE_BYTES,
)
from torchgrasp.foundation.rules import is_tensor

Item = TypeVar("Item")
SomeValue = TypeVar("SomeValue", bound=Value)
VERSION = "1"  # version of the file layout; readers refuse all others
DTYPES = (torch.float32, torch.float64, torch.int64, torch.bool)  # dtypes in our files


class Field(NamedTuple):
    """A value in a JSON or TOML file, with the file's path and the field's name.

    `path` is the file. `place` names the field, such as `objects.cup`, "" for the whole file.
    `value` is what the parser read. `refuse(found, allowed)` makes the error for a bad value, from
    sentences on what was found and what is allowed. It is the error that all methods raise for a
    value that they do not accept.
    """

    path: Path
    place: str
    value: Any
    refuse: Refuse

    def wrong(self, allowed: str) -> BadArgument:
        """Return the error for a bad value of this field, made by `refuse`. `allowed` says which
        values are allowed, such as "a list". The error is not raised here.
        """
        try:
            text = repr(self.value)[: SHOWN_LETTERS + 1]
        except ValueError:  # Python writes no whole number of more than 4300 digits
            text = "a huge number"
        shown = text if len(text) <= SHOWN_LETTERS else f"{text[:SHOWN_LETTERS]}..."
        return self.refuse(f"{self.path}: {self.place or 'the file'} = {shown}", allowed)

    def entries(self, *required: str) -> "dict[str, Field]":
        """Return the entries of a JSON object as fields, by name.

        Raises the error that `refuse` makes if the value is no object, or lacks one of the
        `required` names.
        """
        if not isinstance(self.value, dict):
            raise self.wrong("an object { }")
        if missing := [name for name in required if name not in self.value]:
            raise self.wrong(f"an object with {missing[0]!r}")
        within = f"{self.place}." if self.place else ""
        return {
            key: Field(self.path, f"{within}{key}", value, self.refuse)
            for key, value in self.value.items()
        }

    def items(self, most: int = 1000) -> "list[Field]":
        """Return the items of a list as fields. Raises the error that `refuse` makes if the value
        is no list, or has more than `most` items.
        """
        if not isinstance(self.value, list) or len(self.value) > most:
            raise self.wrong(f"a list of at most {most}")
        return [
            Field(self.path, f"{self.place}[{i}]", x, self.refuse) for i, x in enumerate(self.value)
        ]

    def text(self, most: int = JSON_LETTERS) -> str:
        """Return the value as a text of at most `most` letters, by default 200 (`JSON_LETTERS`).
        Raises the error that `refuse` makes for a value that is no such text.
        """
        if not isinstance(self.value, str) or len(self.value) > most:
            raise self.wrong(f"a text of at most {most} letters")
        return self.value

    def number(self, low: float = -sys.float_info.max, high: float = sys.float_info.max) -> float:
        """Return the value as a number in [low, high], by default any finite number. Raises the
        error that `refuse` makes for a value that is no such number, such as true or false.
        """
        number = self.value
        if (
            isinstance(number, bool)
            or not isinstance(number, int | float)
            or not low <= number <= high
        ):
            raise self.wrong(
                "a finite number"
                if high == sys.float_info.max
                else f"a number in [{low:g}, {high:g}]"
            )
        return float(number)

    def numbers(
        self, count: int, low: float = -sys.float_info.max, high: float = sys.float_info.max
    ) -> list[float]:
        """Return the value as a list of `count` numbers in [low, high], by default any finite ones.
        Raises the error that `refuse` makes for a value that is no such list.
        """
        if not isinstance(self.value, list) or len(self.value) != count:
            raise self.wrong(f"{count} numbers")
        return [x.number(low, high) for x in self.items(count)]

    def whole(self, low: int, high: int) -> int:
        """Return the value as a whole number in [low, high]. Raises the error that `refuse` makes
        for a value that is no such number, such as 1.0 or true.
        """
        if (
            isinstance(self.value, bool)
            or not isinstance(self.value, int)
            or not low <= self.value <= high
        ):
            raise self.wrong(f"a whole number in [{low}, {high}]")
        return self.value


def read_json(path: Path, refuse: Refuse, allowed: str, most: int = JSON_BYTES) -> Field:
    """Return the content of a JSON file as a field.

    The file must be in UTF-8, with at most `most` bytes, by default 32 MiB (`JSON_BYTES`). It has
    no NaN or infinity, and each name once in its object. For another file the error
    `refuse(found, allowed)` is raised, and later for each bad value of the field. `allowed` says
    what is expected.
    """
    data = read_bounded(path, most, allowed, refuse)
    try:
        value = json.loads(
            data.decode("utf-8"),
            parse_constant=_refuse_constant,
            object_pairs_hook=_refuse_doubles,
        )
    except (ValueError, RecursionError) as error:
        raise refuse(f"{path}: {error}", allowed) from error
    return Field(path, "", value, refuse)


def _refuse_constant(name: str) -> float:
    """Raise `ValueError` for NaN and Infinity, which Python's reader would accept."""
    raise ValueError(f"{name}, which is no JSON")


def _refuse_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object; raise `ValueError` for a name that it has twice, of which Python's
    reader would keep the last value alone.
    """
    found = dict(pairs)
    if len(found) < len(pairs):
        name, _ = Counter(name for name, _ in pairs).most_common(1)[0]
        raise ValueError(f"{name[:SHOWN_LETTERS]!r} twice in one object")
    return found


def save_tensors(
    path: Path | str, kind: str, tensors: dict[str, Tensor], meta: dict[str, str]
) -> Path:
    """Write tensors and metadata (`meta`) by name to a safetensors file, and return its path.
    `kind`, a word for the content such as "grasps", is added to the metadata of the file.

    Raises `OutputError` if the file cannot be written.
    """
    # as bytes, since a full disk then is an OSError, which save_file makes an error of its own
    return write_file(path, pack_tensors(kind, tensors, meta))


def pack_tensors(kind: str, tensors: dict[str, Tensor], meta: dict[str, str]) -> bytes:
    """Return the bytes of a safetensors file with tensors and metadata (`meta`) by name.

    The metadata also hold the `kind` of the file, a word such as "grasps", and the version of its
    layout. Equal tensors and metadata give equal bytes.
    """
    contiguous = {
        name: t.detach().cpu().contiguous().clone() for name, t in tensors.items()
    }  # a file shares no memory
    # One JSON string: safetensors writes several metadata keys in random order, and equal values
    # must give equal bytes.
    return save(
        contiguous,
        {"torchgrasp": json.dumps({**meta, "kind": kind, "version": VERSION}, sort_keys=True)},
    )


def load_tensors(
    path: Path | str, kind: str, names: set[str], optional: Collection[str] = ()
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return the tensors and the metadata of a safetensors file, each by name.

    `kind` is the word for its content, such as "grasps", that the file's metadata must hold. It and
    the version of the layout are left out of the result. The file must hold the tensors `names`,
    and may hold those in `optional`. Raises `ModelFileError` for a missing or broken file, and for
    another kind or version of the layout. Raises it also for missing or further tensors, and for
    numbers that are not finite, or greater than 1e30 in size.
    """
    allowed = names.union(optional)
    refuse = functools.partial(ModelFileError, "path")
    check_file(path, TENSOR_FILE_BYTES, f"a safetensors file of kind {kind!r}", refuse)
    try:
        with safe_open(path, framework="pt") as file:
            meta = json.loads((file.metadata() or {}).get("torchgrasp", "{}"))
            found = set(file.keys())
            # The others stay unread. A copy is aligned as what was saved: unaligned numbers round
            # otherwise.
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
    del meta["kind"], meta["version"]
    return tensors, meta


def read_value(
    path: Path | str, kind: str, of: type[SomeValue], **rest: Any
) -> tuple[SomeValue, dict[str, str]]:
    """Return a value of class `of`, and the metadata by name, from a safetensors file.

    `kind` is the word for its content, such as "grasps", that the file's metadata must hold. The
    tensors of the file have the names of the fields of class `of`. `rest` gives the fields that are
    no tensors; those left out keep their defaults.

    Raises `ModelFileError` for a missing or broken file, and for another kind or version of the
    layout. Raises it also for missing or further tensors, and for numbers that are not finite, or
    greater than 1e30 in size. It is also raised for a tensor whose shape or dtype is not that of
    the field's annotation.
    """
    fields = _tensor_fields(of)
    optional = {name for name, kinds in fields.items() if type(None) in kinds}
    tensors, meta = load_tensors(path, kind, set(fields) - optional, optional)
    with jaxtyped("context"):  # binds the letters of the annotations
        for name, tensor in tensors.items():
            if not isinstance(tensor, fields[name][0]):
                found = f"{path}: {name} of shape {tuple(tensor.shape)} and {tensor.dtype}"
                raise ModelFileError(
                    "path", found, f"{fields[name][0]}, and one size for each letter"
                )
    return _build(of, tensors, "", rest), meta


def _tensor_fields(of: type[Value], prefix: str = "") -> dict[str, tuple[Any, ...]]:
    """Return the allowed types of all tensors in a value class by dotted name; for an optional one
    also NoneType.
    """
    fields: dict[str, tuple[Any, ...]] = {}
    for name, hint in _hints(of).items():
        kinds = typing.get_args(hint) if typing.get_origin(hint) not in (None, dict) else (hint,)
        if _is_value(hint):
            fields |= _tensor_fields(hint, f"{prefix}{name}.")
        elif is_tensor(kinds[0]):
            fields[prefix + name] = kinds
    return fields


def _build(
    of: type[SomeValue], tensors: dict[str, Tensor], prefix: str, rest: dict[str, Any]
) -> SomeValue:
    """Return a value of class `of` built from tensors by dotted name; a missing tensor becomes
    None.
    """
    values = {
        name: tensors.get(prefix + name) for name in _tensor_fields(of) if "." not in name
    } | rest
    nested = {name: hint for name, hint in _hints(of).items() if _is_value(hint)}
    return of(
        **values,
        **{name: _build(hint, tensors, f"{prefix}{name}.", {}) for name, hint in nested.items()},
    )


def _hints(of: type[Value]) -> dict[str, Any]:
    hints = typing.get_type_hints(of)
    return {field.name: hints[field.name] for field in dataclasses.fields(of)}  # pyright: ignore[reportArgumentType]


def _is_value(hint: Any) -> bool:
    return typing.get_origin(hint) is None and isinstance(hint, type) and issubclass(hint, Value)


class Recent(Generic[Item]):
    """A cache of the items that were used last, each under an integer that identifies it.

    `most` is the greatest number of items kept, and `kept` holds them by their integers. A copy in
    another process starts empty.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self.kept: dict[int, Item] = {}

    def get(self, number: int, read: Callable[[int], Item]) -> Item:
        """Return the item that `number` identifies; `read(number)` reads it if it is not in the
        cache.
        """
        item = self.kept.pop(number, None)
        item = read(number) if item is None else item
        self.kept[number] = item  # now the last one
        for oldest in list(self.kept)[: -self.most]:
            self.kept.pop(oldest, None)
        return item

    def __reduce__(self) -> tuple[Any, ...]:
        return Recent, (self.most,)
