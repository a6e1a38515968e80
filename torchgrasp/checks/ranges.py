"""Ranges of numbers, as annotations: `Annotated[float, Range(0.0, 1.0)]`, and the common ones by name."""

import sys
from typing import Annotated, NamedTuple

from jaxtyping import Float
from torch import Tensor


class Range(NamedTuple):
    """The numbers from `low` to `high`, both allowed; `words` replace the brackets in an error.

    >>> Range(0.0, 1.0).describe("a number")
    'a number in [0, 1]'
    """

    low: float
    high: float
    words: str = ""

    def describe(self, kind: str) -> str:
        """Return what is allowed, in words."""
        return self.words or f"{kind} in [{self.low:.12g}, {self.high:.12g}]"


class Rows(NamedTuple):
    """The mark of a batch in a value: it has as many rows as a letter says, `Annotated[Contacts, Rows("g")]`.

    >>> Rows("g").letter
    'g'
    """

    letter: str


ANY, FINITE = "any number, NaN and infinity too", "finite numbers in every field"
"""Marks of an annotation, `Annotated[Float[Tensor, "b"], ANY]`. Floating numbers must be finite without one, but the
fields of a batch may say that theirs need not. A function that reads all rows then asks for `FINITE`."""
RIGID = "a rigid transform: a right-handed rotation, and the row 0 0 0 1"
"""The mark of transforms, `Annotated[Float[Tensor, "4 4"], RIGID]`: one that scales or mirrors gives no error later."""
LEAST, MOST = sys.float_info.min, sys.float_info.max
"""Least positive and largest finite number: an annotation without a range means finite numbers."""

Seed = Annotated[int, Range(0, 2**63 - 1, "a whole number from 0 to 2**63 - 1")]
"""A seed of random draws; torch's generators take no larger ones."""
Count = Annotated[int, Range(1, 1_000_000)]
"""A number of things that are kept in memory; a million starts or rows already take hours or gigabytes."""
Positive = Annotated[float, Range(LEAST, MOST, "a positive number")]
"""A number above zero."""
Fraction = Annotated[float, Range(0.0, 1.0)]
"""A share or a probability."""
Measured = Annotated[float, ANY]
"""A number that is NaN where nothing was measured."""
Pose = Annotated[Float[Tensor, "4 4"], RIGID]
"""A rigid transform."""
Poses = Annotated[Float[Tensor, "g 4 4"], RIGID]
"""A rigid transform for each row."""
Length = Annotated[float, Range(0.0, 10.0)]
"""A length [m] of things within reach."""
