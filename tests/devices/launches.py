"""A count of what a call on the pretended device would cost a GPU: kernel launches, waits of the
host, and uploads.

`Launches` watches every operation of aten that runs while `TRAFFIC` says that the device works. The
rules are:

- A launch is an operation that writes at least one number. Views and empty results launch nothing.
  An operation counts once, even if it starts several kernels there: a factorisation, a sort, a
  choice by a mask.
- A read is an operation after which the host waits, because it needs a number or the size of a
  result.
- An upload is a copy from the host. The host may wait for the copy, too.
"""

import sys
from collections import Counter
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from tests.devices.elsewhere import TRAFFIC

LIBRARY = str(Path(__file__).resolve().parents[2] / "torchgrasp") + "/"
HELPERS = ("foundation/base.py", "foundation/checks.py", "foundation/rules.py")
"""Files whose operations belong to the caller."""
IDLE = {
    "empty",
    "empty_like",
    "empty_strided",
    "new_empty",
    "new_empty_strided",
    "_unsafe_view",
    "_local_scalar_dense",
}
"""Operations without a kernel whose results are no views."""
WAITS = {
    "_linalg_check_errors",
    "_linalg_eigh",
    "_linalg_svd",
    "linalg_eig",
    "linalg_lstsq",
    "multinomial",
}
"""Operations that wait on a GPU, which their tags do not say: they read whether they succeeded."""
CHOICES = {"index", "index_put", "index_put_", "_index_put_impl_"}
"""Operations that wait for each index that is a mask."""


class Place(NamedTuple):
    """A line of the library, its function, and the stage of the planner."""

    file: str
    line: int
    function: str
    stage: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line} {self.function}"


class Launches(TorchDispatchMode):
    """Counts in `found`, by kind and place, what the calls inside the context would do on a GPU.

    The kinds are "launch", "read" and "upload".

    Args:
        stages: name of the stage of each function of the planner; the innermost one counts.
    """

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Tell torch not to import its compiler for a check of each operation."""
        return False

    def __init__(self, stages: dict[str, str] | None = None) -> None:
        super().__init__()
        self.stages = stages or {}
        self.found = Counter[tuple[str, Place]]()

    def __enter__(self) -> "Launches":
        """Begin to count."""
        TRAFFIC.tell = self.note
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        """Stop counting."""
        TRAFFIC.tell = lambda kind: None
        super().__exit__(*error)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run one operation, and count it."""
        kwargs = kwargs or {}
        result = func(*args, **kwargs)
        if not TRAFFIC.running:  # work of the host
            return result
        for _ in range(reads(func, args, kwargs)):
            self.note("read")
        if launches(func, result):
            self.note("launch")
        return result

    def note(self, kind: str) -> None:
        """Count an event at the present place."""
        self.found[kind, place(sys._getframe(1), self.stages)] += 1

    def total(self, kind: str) -> int:
        """Return the number of events of a kind."""
        return sum(count for (name, _), count in self.found.items() if name == kind)

    def by_stage(self, kind: str) -> Counter[str]:
        """Return the number of events of a kind in each stage."""
        counts = Counter[str]()
        for (name, at), count in self.found.items():
            counts[at.stage] += count * (name == kind)
        return counts

    def most(self, kind: str, number: int) -> list[tuple[Place, int]]:
        """Return the lines with the most events of a kind, in all stages together."""
        counts = Counter[Place]()
        for (name, at), count in self.found.items():
            counts[at._replace(stage="")] += count * (name == kind)
        return counts.most_common(number)


def place(frame: FrameType | None, stages: dict[str, str]) -> Place:
    """Return the innermost line of the library above a frame, and its stage."""
    file = ""
    line = 0
    function = ""
    stage = ""
    while frame is not None and not (file and function and stage):
        code = frame.f_code
        if code.co_filename.startswith(LIBRARY):
            name = code.co_filename[len(LIBRARY) :]
            if not file and name not in HELPERS:
                file = name
                line = frame.f_lineno
            if (
                not function and name == file and not code.co_name.startswith("<")
            ):  # a list is made in its function
                function = code.co_name
            stage = stage or stages.get(code.co_name, "")
        frame = frame.f_back
    return Place(file or "outside", line, function, stage or "other")


@cache
def makes_numbers(func: Any) -> bool:
    """Return whether an operation can write numbers: it is no view and does more than take memory."""
    returned = [x.alias_info for x in func._schema.returns]
    is_view = bool(returned) and all(alias is not None and not alias.is_write for alias in returned)
    return not is_view and func.overloadpacket.__name__ not in IDLE


@cache
def waits(func: Any) -> bool:
    """Return whether the host needs a number, or the size of a result, of an operation."""
    tags = {torch.Tag.data_dependent_output, torch.Tag.dynamic_output_shape}
    return bool(tags & set(func.tags)) or func.overloadpacket.__name__ in WAITS


def reads(func: Any, args: Any, kwargs: dict[str, Any]) -> int:
    """Return how often the host waits in an operation."""
    if func.overloadpacket.__name__ in CHOICES:
        masks = sum(isinstance(x, Tensor) and x.dtype in (torch.bool, torch.uint8) for x in args[1])
        is_fill = len(args) > 2 and args[2].numel() == 1 and masks == 1
        return 0 if is_fill else masks
    return int(waits(func) and kwargs.get("output_size") is None)


def launches(func: Any, result: Any) -> bool:
    """Return whether an operation launches a kernel: it writes at least one number."""
    results = result if isinstance(result, tuple | list) else [result]
    return makes_numbers(func) and any(isinstance(x, Tensor) and x.numel() > 0 for x in results)
