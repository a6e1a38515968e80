"""Tensors and metadata as one safetensors file, which is checked when it is read."""

import json
from collections.abc import Collection
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from torchgrasp.errors import ModelFileError
from torchgrasp.files.read import is_file
from torchgrasp.files.write import write_file

VERSION = "1"
"""Version of the file layout; readers refuse any other."""

DTYPES = (torch.float32, torch.float64, torch.int64, torch.bool)
"""Types of numbers in our files. Of others, such as float8, torch cannot even tell which are finite."""

MOST_BYTES = 1024**3
"""Largest file [bytes]: hundreds of times the largest of ours, a chunk of samples."""

LARGEST = 1e30
"""Largest number: beyond it float32 and squares in float64 overflow. No length, angle, force or score comes near."""


def save_tensors(path: Path | str, kind: str, tensors: dict[str, Tensor], meta: dict[str, str]) -> Path:
    """Write tensors and metadata as one safetensors file of a `kind`, such as "grasps".

    Raises:
        OutputError: the file cannot be written.
    """
    # as bytes, since a full disk then is an OSError, which save_file makes an error of its own
    return write_file(path, pack_tensors(kind, tensors, meta))


def pack_tensors(kind: str, tensors: dict[str, Tensor], meta: dict[str, str]) -> bytes:
    """Return the bytes of such a file; equal values give equal bytes."""
    contiguous = {name: t.detach().cpu().contiguous().clone() for name, t in tensors.items()}  # a file shares no memory
    # One JSON string: safetensors writes several metadata keys in random order, and equal values must give equal bytes.
    header = {"torchgrasp": json.dumps({**meta, "kind": kind, "version": VERSION}, sort_keys=True)}
    return save(contiguous, header)


def load_tensors(
    path: Path | str, kind: str, names: set[str], optional: Collection[str] = ()
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read a safetensors file of a `kind` that holds the tensors `names`, and of others at most the `optional`.

    Raises:
        ModelFileError: the file is missing, malformed or larger than `MOST_BYTES`, has another kind, version or
            tensors, or a number is not finite or beyond `LARGEST`.
    """
    allowed = names.union(optional)
    if not is_file(path):
        raise ModelFileError("path", f"{path}, which is no file", f"a safetensors file of kind {kind!r}")
    if Path(path).stat().st_size > MOST_BYTES:
        raise ModelFileError("path", f"{path} of {Path(path).stat().st_size} bytes", f"at most {MOST_BYTES} bytes")
    try:
        with safe_open(path, framework="pt") as file:
            meta = json.loads((file.metadata() or {}).get("torchgrasp", "{}"))
            found = set(file.keys())
            # The others stay unread. A copy is aligned as what was saved: unaligned numbers round otherwise.
            tensors = {name: file.get_tensor(name).clone() for name in found & allowed}
    except (SafetensorError, OSError, ValueError, KeyError, RecursionError) as error:
        raise ModelFileError("path", f"{path}: {error}", f"a safetensors file of kind {kind!r}") from error
    if not isinstance(meta, dict) or not all(isinstance(x, str) for x in meta.values()):
        raise ModelFileError("path", f"{path}: metadata that is no object of texts", f"kind {kind!r}")
    if meta.get("kind") != kind or meta.get("version") != VERSION:
        other = f"kind {meta.get('kind')!r}, version {meta.get('version')!r}"
        raise ModelFileError("path", f"{path}: {other}", f"kind {kind!r}, version {VERSION!r}")
    if not names <= found <= allowed:
        raise ModelFileError("path", f"{path}: tensors {sorted(found)}", f"tensors {sorted(names)}")
    for name, t in tensors.items():
        if t.dtype not in DTYPES:
            raise ModelFileError("path", f"{path}: {name} of {t.dtype}", f"one of {', '.join(map(str, DTYPES))}")
        if t.is_floating_point() and not bool((t.abs() <= LARGEST).all()):
            found = f"{path}: a number beyond {LARGEST:g} or a non-finite number in {name}"
            raise ModelFileError("path", found, "finite numbers")
    return tensors, meta
