#!/usr/bin/env python
"""Count what a reader of the library meets, folder by folder: lines, files, numbers at module
level, public names.

python scripts/survey.py            the counts, and sentences of docstrings that are long
"""

import argparse
import ast
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MOST_WORDS = 30
"""Words of a sentence; longer ones are listed."""


def main() -> int:
    """Print the counts and the long sentences."""
    counts = defaultdict(lambda: [0, 0, 0, 0])
    public = set[str]()
    long: list[str] = []
    for path in sorted((ROOT / "torchgrasp").rglob("*.py")):
        text = path.read_text()
        inner = path.relative_to(ROOT / "torchgrasp")
        tree = ast.parse(text)
        count = counts["/".join(inner.parts[:-1]) or "torchgrasp"]
        names = exported(tree)
        for k, n in enumerate((len(text.splitlines()), 1, sum(numbers(tree)), len(names))):
            count[k] += n
        public |= names
        long += [
            f"{path.relative_to(ROOT)}:{line}: {sentence}"
            for line, sentence in long_sentences(tree)
        ]
    total = [sum(count[k] for count in counts.values()) for k in range(3)]
    print(f"{'folder':24}{'lines':>8}{'files':>8}{'numbers':>8}{'public':>8}")
    for name, count in [*sorted(counts.items()), ("all, names once", [*total, len(public)])]:
        print(f"{name:24}" + "".join(f"{n:8}" for n in count))
    print(f"\n{len(long)} sentences of more than {MOST_WORDS} words", *long, sep="\n  ")
    return 0


def exported(tree: ast.Module) -> set[str]:
    """Return the names in `__all__`."""
    lists = [
        n.value
        for n in tree.body
        if isinstance(n, ast.Assign) and ast.unparse(n.targets[0]) == "__all__"
    ]
    return {name for names in lists for name in ast.literal_eval(names)}


def numbers(tree: ast.Module) -> Iterator[int]:
    """Yield how many names each assignment of numbers at module level has."""
    for node in tree.body:
        if (
            isinstance(node, ast.Assign | ast.AnnAssign)
            and node.value is not None
            and is_number(node.value)
        ):
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            yield len(target.elts) if isinstance(target, ast.Tuple) else 1


def is_number(node: ast.expr) -> bool:
    """Tell whether an expression is a number, a tuple of numbers, or arithmetic with one."""
    match node:
        case ast.Constant(value=value):
            return type(value) in (int, float)
        case ast.UnaryOp(operand=operand):
            return is_number(operand)
        case ast.BinOp(left=left, right=right):
            return is_number(left) or is_number(right)
        case ast.Tuple(elts=elements) | ast.List(elts=elements):
            return bool(elements) and all(map(is_number, elements))
    return False


def long_sentences(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and text of the long sentences of docstrings, without examples."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            prose = re.split(r"\n\s*>>>", ast.get_docstring(node) or "")[0]
            for block in re.split(r"\n\s*\n|\n\s*(?=\w+: |\* )", prose):
                for sentence in re.split(r"(?<=[.!?;])\s+", " ".join(block.split())):
                    if len(re.findall(r"[A-Za-z][A-Za-z'-]*", sentence)) > MOST_WORDS:
                        yield getattr(node, "lineno", 1), sentence


if __name__ == "__main__":
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    sys.exit(main())
