"""Files: written completely or not at all, in locked folders, and read within limits. Not public.

No file is pickled: a file from a stranger may be malformed, but it cannot run code.
"""

from torchgrasp.files.write import format_columns as format_columns, format_json as format_json
from torchgrasp.files.write import (
    format_line as format_line,
    is_file as is_file,
    plain_value as plain_value,
    read_bytes as read_bytes,
)
from torchgrasp.files.write import (
    check_file as check_file,
    read_bounded as read_bounded,
    remove_file as remove_file,
)
from torchgrasp.files.write import render as render, sha256 as sha256, write_file as write_file
from torchgrasp.files.write import Malformed as Malformed, explain as explain
from torchgrasp.files.write import (
    LOCK as LOCK,
    begin_folder as begin_folder,
    check_begun as check_begun,
)
from torchgrasp.files.write import hold_file as hold_file, hold_folder as hold_folder
from torchgrasp.files.write import (
    template_engine as template_engine,
    temporary_folder as temporary_folder,
)
from torchgrasp.files.fields import (
    DTYPES as DTYPES,
    VERSION as VERSION,
    Field as Field,
    Recent as Recent,
)
from torchgrasp.files.fields import load_tensors as load_tensors, pack_tensors as pack_tensors
from torchgrasp.files.fields import (
    read_json as read_json,
    read_value as read_value,
    save_tensors as save_tensors,
)
