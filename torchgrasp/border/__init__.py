"""The border of the library: arguments of public functions, and fields of values, are checked by their annotations.

`checked` decorates a public function or a value's class. A call from outside is then compared with the signature: type,
shape, dtype, finite numbers, range. Calls from inside pass unread, so nothing is checked twice. What depends on more
than one argument, or on what a file holds, stays in the function.
"""

from torchgrasp.border.checked import checked
from torchgrasp.border.paths import check_path
from torchgrasp.border.ranges import ANY, FINITE, LEAST, RIGID, Count, Fraction, Length, Measured
from torchgrasp.border.ranges import Pose, Poses, Positive, Range, Rows, Seed
from torchgrasp.border.tensors import check_moved, check_tensor, show

__all__ = [
    "ANY",
    "FINITE",
    "Count",
    "LEAST",
    "Fraction",
    "Length",
    "Measured",
    "Pose",
    "Poses",
    "Positive",
    "RIGID",
    "Range",
    "Rows",
    "Seed",
    "check_moved",
    "check_path",
    "check_tensor",
    "checked",
    "show",
]
