"""Scores of a small evaluation with every kind of outcome: what tests of sums and pages start from."""

import dataclasses
import math

from torchgrasp.evaluation.summary import ProtocolResult, ViewScore
from torchgrasp.foundation.errors import Status

GOOD = ProtocolResult(0, 0, True, Status.OK, 0.01, 0.1, 4.0, 0.002, 1.0)
SLIPPED = dataclasses.replace(GOOD, rank=1, passed=False, status=Status.MOVED, overlap=0.004)
STUCK = dataclasses.replace(
    GOOD, passed=False, status=Status.START_OVERLAP, force=math.nan, overlap=math.nan
)
HUNG = dataclasses.replace(
    SLIPPED, status=Status.TIMED_OUT, force=math.nan, overlap=math.nan, seconds=math.nan
)
SCORES = [
    ViewScore("tin", "view0", 9, 2.0, (GOOD, SLIPPED)),
    ViewScore("tin", "view1", 0, 4.0, (), Status.OBJECT_COLLISION),
    ViewScore("cup", "view0", 1, 3.0, (STUCK, HUNG)),
    ViewScore("sieve", "view0", 0, math.nan, (), Status.BAD_OBJECT, "an <open> surface"),
]
