#!/usr/bin/env python
"""Count how the library is built: tokens, packed assignments, numbers in function bodies, names
that occur twice.

python scripts/survey.py            the counts of the library, folder by folder, and the names
python scripts/survey.py scripts    the same of another folder
"""

import argparse
import ast
import io
import sys
import tokenize
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PLAIN = {0.0, 1.0, 2.0, 0.5, 3.0, 4.0, 10.0, 100.0, 1000.0, 180.0, 90.0, 360.0}
"""Numbers with a point that a function body may have: neutral ones and units."""
FEW = range(-4, 11)
"""Whole numbers that a function body may have: axes, rows and small counts."""
COUNTED = {tokenize.NAME, tokenize.OP, tokenize.NUMBER}
"""Tokens that are counted. Text, comments and line ends are free."""


class Counts(NamedTuple):
    """The counts of the source of a file or a folder.

    `lines` are lines with code. `packed` are those of the `assignments` that have tuples on both
    sides. `numbers` are those in function bodies that need a name.
    """

    files: int = 0
    tokens: int = 0
    lines: int = 0
    assignments: int = 0
    packed: int = 0
    numbers: int = 0

    def plus(self, other: "Counts") -> "Counts":
        """Return the sum of two counts.

        >>> Counts(1, 20, 3).plus(Counts(1, 30, 4)).tokens
        50
        """
        return Counts(*(a + b for a, b in zip(self, other, strict=True)))


def count(source: str) -> Counts:
    """Return the counts of the source of a file.

    >>> count("a, b = 1, 2").packed
    1
    """
    tree = ast.parse(source)
    tokens = sum(
        token.type in COUNTED for token in tokenize.generate_tokens(io.StringIO(source).readline)
    )
    assignments = [node for node in ast.walk(tree) if isinstance(node, ast.Assign)]
    packed = [
        node
        for node in assignments
        if isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple)
    ]
    numbers = sum(1 for _ in numbers_in_bodies(tree))
    return Counts(1, tokens, count_lines(source, tree), len(assignments), len(packed), numbers)


def count_lines(source: str, tree: ast.Module) -> int:
    """Return the number of lines of a source with code: docstrings, comments and empty lines do not
    count.
    """
    told: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            if isinstance(node.value.value, str):
                told |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    lines = enumerate(source.splitlines(), start=1)
    return sum(
        bool(line.strip()) and not line.strip().startswith("#") and number not in told
        for number, line in lines
    )


def numbers_in_bodies(tree: ast.Module) -> Iterator[ast.Constant]:
    """Yield the literal numbers in function bodies that need a name (`is_tuned`)."""
    for function in ast.walk(tree):
        if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        for statement in function.body:
            if isinstance(statement, ast.FunctionDef | ast.ClassDef):
                continue  # counted by itself
            for node in ast.walk(statement):
                if isinstance(node, ast.Constant) and is_tuned(node.value):
                    yield node


def is_tuned(value: object) -> bool:
    """Tell whether a value is a number that needs a name: neither neutral, nor a unit, nor a small
    count.

    >>> is_tuned(0.35), is_tuned(0.5), is_tuned(3), is_tuned(True)
    (True, False, False, False)
    """
    if type(value) is float:
        return abs(value) not in PLAIN
    return type(value) is int and value not in FEW


def twice(places: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    """Return the names that occur at several places, each with its places.

    `places` are pairs of name and place.

    >>> twice([("Row", "a.py"), ("Row", "b.py"), ("Cell", "a.py")])
    {'Row': ['a.py', 'b.py']}
    """
    found = defaultdict(list)
    for name, place in places:
        found[name].append(place)
    return {name: some for name, some in found.items() if len(some) > 1}


def exported(tree: ast.Module) -> Iterator[str]:
    """Yield the names in the list `__all__` of a module."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            yield from ast.literal_eval(node.value)


def report(package: Path) -> str:
    """Return as text the counts of a package by its folders, and the names that occur twice."""
    folders = defaultdict(Counts)
    files = list[tuple[str, str]]()
    classes = list[tuple[str, str]]()
    public = list[tuple[str, str]]()
    for path in sorted(package.rglob("*.py")):
        source = path.read_text()
        place = path.relative_to(package).as_posix()
        folder, slash, _ = place.partition("/")
        tree = ast.parse(source)
        name = folder if slash else package.name
        folders[name] = folders[name].plus(count(source))
        files += [(path.name, place)] if path.name != "__init__.py" else []
        classes += [(node.name, place) for node in tree.body if isinstance(node, ast.ClassDef)]
        public += [(name, place) for name in exported(tree)]
    everything = Counts()
    for found in folders.values():
        everything = everything.plus(found)
    heads = ("files", "tokens", "lines", "a line", "assigned", "packed", "numbers")
    lines = [f"{'folder':16}" + "".join(f"{head:>10}" for head in heads)]
    for name, found in [*sorted(folders.items()), ("all", everything)]:
        rate = f"{found.tokens / max(found.lines, 1):.1f}"
        cells = (*found[:3], rate, *found[3:])
        lines.append(f"{name:16}" + "".join(f"{cell:>10}" for cell in cells))
    for what, places in (
        ("file names that occur twice", files),
        ("class names that occur twice", classes),
        ("public names in two lists", public),
    ):
        found = twice(places)
        lines += ["", f"{len(found)} {what}"]
        lines += [f"  {name}: {', '.join(some)}" for name, some in found.items()]
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "folder", nargs="?", type=Path, default=ROOT / "torchgrasp", help="folder to count"
    )
    print(report(parser.parse_args().folder))
    sys.exit(0)
