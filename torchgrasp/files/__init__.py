"""Files: whole or not at all, in locked folders; tensors as safetensors with JSON metadata.

Nothing here is pickled: a file from a stranger can be malformed, but it cannot run code.
"""

from torchgrasp.files.hold import LOCK, hold_file, hold_folder, temporary_folder
from torchgrasp.files.read import is_file, sha256
from torchgrasp.files.tensors import DTYPES, MOST_BYTES, VERSION, load_tensors, save_tensors
from torchgrasp.files.write import format_json, is_remnant, write_file

__all__ = [
    "DTYPES",
    "LOCK",
    "MOST_BYTES",
    "VERSION",
    "format_json",
    "hold_file",
    "hold_folder",
    "is_file",
    "is_remnant",
    "load_tensors",
    "save_tensors",
    "sha256",
    "temporary_folder",
    "write_file",
]
