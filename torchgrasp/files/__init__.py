"""Files: whole or not at all, in locked folders; tensors as safetensors with JSON metadata. Not public.

Nothing here is pickled: a file from a stranger can be malformed, but it cannot run code.
"""

from torchgrasp.files.hold import LOCK as LOCK, begin_folder as begin_folder
from torchgrasp.files.hold import hold_file as hold_file, hold_folder as hold_folder
from torchgrasp.files.hold import temporary_folder as temporary_folder
from torchgrasp.files.read import is_file as is_file, read_bytes as read_bytes, sha256 as sha256
from torchgrasp.files.recent import Recent as Recent
from torchgrasp.files.tensors import DTYPES as DTYPES, MOST_BYTES as MOST_BYTES, VERSION as VERSION
from torchgrasp.files.tensors import load_tensors as load_tensors, pack_tensors as pack_tensors
from torchgrasp.files.tensors import save_tensors as save_tensors
from torchgrasp.files.write import format_json as format_json, is_remnant as is_remnant
from torchgrasp.files.write import remove_file as remove_file, write_file as write_file
