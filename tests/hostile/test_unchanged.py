"""Public calls, with valid and with hostile arguments, change neither these nor the state of the
process.

They run in a process of their own: the annotation checks of the tests draw from Python's global
generator themselves.
"""

import dataclasses
import random
import sys
import warnings
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.apart import run_apart
from tests.hostile.arguments import checked_things, required, wrong_arguments
from tests.hostile.samples import hints_of
from tests.hostile.unchanged import changes
from tests.pinch import QUICK
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.rules import Count
from torchgrasp.values.closing import ClosingOptions
from torchgrasp.values.specs import TrialSpec

IMPORTED = "sympy", "sapien"
"""Packages of others that are imported late, and leave a filter of warnings and variables of the
environment.
"""
ONCE = dataclasses.replace(QUICK, options=ClosingOptions(attempts=1))
"""A trial in which a hand that misses the object ends soon."""
EACH = 4
"""Every so many-th wrong argument is given, from another first one to each call."""
SWEEP = (
    "from pathlib import Path; from tests.hostile.test_unchanged import sweep; sweep(Path({!r}))"
)


def sweep(folder: Path) -> None:
    """Print every call that changes something, and what."""
    warnings.simplefilter("ignore")
    for package in filter(find_spec, IMPORTED):
        import_module(package)
    for number, (name, (make, annotated)) in enumerate(sorted(checked_things().items())):
        call = make()
        hints = hints_of(annotated)
        good = required(annotated, call, folder)
        least = {Count: 1, TrialSpec | None: ONCE}  # one start, one row, a short trial: little work
        one: dict[str, Any] = {key: least[hint] for key, hint in hints.items() if hint in least}
        # Beartype draws which items it looks at.
        wrong = list(wrong_arguments(annotated, call))[number % EACH :: EACH]
        value = getattr(call, "__self__", None)
        kept = [value if isinstance(value, Value) else None, good, [x for _, x in wrong]]

        def run(call: Any = call, good: Any = good | one) -> None:
            call(**good)

        def refuse(call: Any = call, good: Any = good, wrong: Any = wrong) -> None:
            for key, x in wrong:
                try:
                    call(**good | {key: x})
                except Exception:  # which one is asserted elsewhere
                    continue

        for how, act in (("valid", run), ("hostile", refuse)):
            if changed := changes(act, *kept):
                print(name, how, *changed, sep="; ", flush=True)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda x: x["points"][0].neg_(), "argument 0"),
        (lambda x: x.update(more=1), "argument 0"),
        (lambda x: torch.rand(1), "generator of torch"),
        (lambda x: random.random(), "generator of Python"),
        (lambda x: warnings.simplefilter("ignore"), "warnings.filters"),
        (lambda x: sys.path.append("nowhere"), "sys.path"),
    ],
)
def test_changes_are_noticed_even_where_the_call_raises(change, found):
    given = {"points": torch.ones(2, 3)}
    path = list(sys.path)
    state = random.getstate()

    def call() -> None:
        change(given)
        raise ValueError

    with warnings.catch_warnings(), torch.random.fork_rng(devices=[]):
        noticed = changes(call, given)
    sys.path[:] = path
    random.setstate(state)
    assert noticed == [found]


def test_a_call_that_changes_nothing_is_told_so():
    given = {"points": torch.ones(2, 3)}
    assert changes(lambda: given["points"] + 1, given) == []


@pytest.mark.promise("N10")
def test_no_call_changes_its_arguments_or_the_state_of_the_process(tmp_path):
    assert run_apart(SWEEP.format(str(tmp_path))) == [""]
