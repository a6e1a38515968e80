"""Every equation of the paper is cited where it is implemented, and tested by a test that is named after it."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EQUATIONS = range(1, 29)


def expand(first, last):
    return set(range(int(first), int(last or first) + 1))


def cited():
    """Return the equations cited in the package as `Eq. (n)`, `Eqs. (a)-(b)` or `Eqs. (a), (b)`."""
    found = set()
    for path in (ROOT / "torchgrasp").rglob("*.py"):
        for words in re.findall(r"Eqs?\. ((?:\(\d+\)(?:-\(\d+\)|, | and )?)+)", path.read_text()):
            for first, last in re.findall(r"\((\d+)\)(?:-\((\d+)\))?", words):
                found |= expand(first, last)
    return found


def named():
    """Return the equations in names of tests: `eq21`, or `eq2_to_5` for a range."""
    found = set()
    for path in (ROOT / "tests").rglob("test_*.py"):
        for name in re.findall(r"def (test_\w+)", path.read_text()):
            for first, last in re.findall(r"eqs?(\d+)(?:_to_(?:eq)?(\d+))?", name):
                found |= expand(first, last)
    return found


@pytest.mark.parametrize("number", EQUATIONS)
def test_equation_is_cited_in_the_package(number):
    assert number in cited()


@pytest.mark.parametrize("number", EQUATIONS)
def test_equation_has_a_test_named_after_it(number):
    assert number in named()
