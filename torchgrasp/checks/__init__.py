"""The border of the library: arguments of public functions, and fields of values, are checked by their annotations.

`checked` decorates a public function or a value's class. A call from outside is then compared with the signature: type,
shape, dtype, finite numbers, range. Calls from inside pass unread, so nothing is checked twice. What depends on more
than one argument, or on what a file holds, stays in the function.
"""

from torchgrasp.checks.checked import checked
from torchgrasp.checks.paths import check_path
from torchgrasp.checks.ranges import ANY, FINITE, LEAST, RIGID, Count, Fraction, Length, Measured
from torchgrasp.checks.ranges import Pose, Poses, Positive, Range, Rows, Seed
from torchgrasp.checks.tensors import check_moved, check_tensor, is_rigid, show

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
    "is_rigid",
    "check_path",
    "check_tensor",
    "checked",
    "show",
]
