#!/usr/bin/env python
"""Count what a reader of the library meets: lines, files, wide signatures, long sentences, numbers without a reason.

python scripts/survey.py                      the whole library, with what breaks a limit
python scripts/survey.py torchgrasp/plan      one folder or file of it
"""

import argparse
import ast
import re
import sys
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from statistics import median

MOST_LINES, MOST_FILES, MOST_PARAMETERS, MOST_WORDS = 300, 16, 6, 35
"""Of a file, of a folder, of a function and of a sentence: more of it hides a second idea."""


def main(places: list[str]) -> int:
    """Print the counts of all Python files below the places."""
    root = Path(__file__).resolve().parents[1]
    files = sorted({f for place in places for p in [root / place] for f in ([p] if p.is_file() else p.rglob("*.py"))})
    trees = {f.relative_to(root): ast.parse(f.read_text()) for f in files}
    lines = {f.relative_to(root): len(f.read_text().splitlines()) for f in files}
    folders = Counter(f.parent for f in lines if f.name != "__init__.py")
    sentences = [(len(words(s)), f, line) for f, tree in trees.items() for line, s in doc_sentences(tree)]
    wide = [(f, line, name, n) for f, tree in trees.items() for line, name, n in wide_functions(tree)]
    bare = [(f, line, name) for f, tree in trees.items() for line, name in bare_numbers(tree)]
    prose = [len(words(s)) for tree in trees.values() for s in prose_sentences(tree)]
    long = [f"{f}:{line}: {n}" for n, f, line in sentences if n > MOST_WORDS]
    print(f"{len(lines)} files, {sum(lines.values())} lines, the longest {max(lines.values())}")
    print(f"{len(prose)} docstring sentences: median {median(prose):g} words; {len(long)} of all over {MOST_WORDS}")
    print(f"{len(wide)} functions of more than {MOST_PARAMETERS} parameters, {len(bare)} numbers without a docstring")
    for what, found in {
        f"files over {MOST_LINES} lines": [f"{f}: {n}" for f, n in lines.items() if n > MOST_LINES],
        f"folders over {MOST_FILES} files": [f"{f}: {n}" for f, n in folders.items() if n > MOST_FILES],
        f"functions over {MOST_PARAMETERS} parameters": [f"{f}:{line} {name}: {n}" for f, line, name, n in wide],
        f"sentences over {MOST_WORDS} words": long,
        "numbers without a docstring": [f"{f}:{line} {name}" for f, line, name in bare],
    }.items():
        if found:
            print(f"\n{what}:", *found, sep="\n  ")
    return 0


def words(sentence: str) -> list[str]:
    """Return the words of a sentence; numbers and formulas are none."""
    return re.findall(r"[A-Za-z][A-Za-z'-]*", sentence)


def doc_sentences(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and text of every sentence in docstrings; those of numbers count, examples do not."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            yield from ((getattr(node, "lineno", 1), s) for s in split_sentences(ast.get_docstring(node) or ""))
    body = getattr(tree, "body", [])
    for before, node in pairwise(body):
        if isinstance(before, ast.Assign | ast.AnnAssign) and is_text(node):
            yield from ((node.lineno, s) for s in split_sentences(node.value.value))


def prose_sentences(tree: ast.AST) -> Iterator[str]:
    """Yield the sentences of docstrings that describe, without the lists of arguments, results and errors."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            prose = re.split(r"\n\s*(?:Args|Returns|Raises|Yields):", ast.get_docstring(node) or "")[0]
            prose = re.split(r"\n\s*>>>", prose)[0]
            yield from (s for s in re.split(r"(?<=[.!?])\s+", prose) if words(s))


def split_sentences(text: str) -> list[str]:
    """Split prose at ends of sentences, of paragraphs and of entries of a list."""
    prose = re.split(r"\n\s*>>>", text)[0]
    blocks = re.split(r"\n\s*\n|\n\s*(?=\w+: |\* )|\n(?=Args:|Returns:|Raises:|Yields:)", prose)
    parts = [s for block in blocks for s in re.split(r"(?<=[.!?])\s+", " ".join(block.split()))]
    return [s for s in parts if len(words(s)) > 1]


def wide_functions(tree: ast.AST) -> Iterator[tuple[int, str, int]]:
    """Yield line, name and number of parameters of the functions that have too many."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            given = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
            count = len([a for a in given if a.arg not in ("self", "cls")])
            if count > MOST_PARAMETERS:
                yield node.lineno, node.name, count


def bare_numbers(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and name of the module-level numbers that no docstring follows."""
    for k, node in enumerate(tree.body):
        if isinstance(node, ast.Assign) and re.fullmatch(r"\(?[A-Z_, ]+\)?", ast.unparse(node.targets[0])):
            documented = k + 1 < len(tree.body) and is_text(tree.body[k + 1])
            if not documented and any(isinstance(x, ast.Constant) for x in ast.walk(node.value)):
                yield node.lineno, ast.unparse(node.targets[0])


def is_text(node: ast.AST) -> bool:
    """Tell whether a statement is a string that stands by itself."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("places", nargs="*", default=["torchgrasp"], help="folders and files; by default the library")
    sys.exit(main(parser.parse_args().places))
