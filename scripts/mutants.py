#!/usr/bin/env python3
"""Mutation tests: change one operator or number of the library, and see whether a test notices.

    .venv/bin/python -m pip install cosmic-ray==8.7.0
    .venv/bin/python scripts/mutants.py --folders shape contacts --each 50 --out mutants.json

Cosmic Ray makes the mutants. Each runs in a copy of the repository. The test file of the mutated
module runs first, then the other tests of its folder. A mutant that no test notices has survived.
It needs a test, or it changes no behaviour.
"""

import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue
from typing import NamedTuple

import tyro

ROOT = Path(__file__).resolve().parents[1]
SWAPS = "Add_Sub Sub_Add Mul_Div Div_Mul Pow_Mul BitAnd_BitOr".split()
COMPARISONS = "Lt_Gt Gt_Lt LtE_Gt GtE_Lt Eq_NotEq NotEq_Eq Is_IsNot IsNot_Is".split()
OTHERS = "UnaryOperator_Delete_USub AndWithOr OrWithAnd TrueWithFalse FalseWithTrue".split()
NAMES = (
    *(f"core/ReplaceBinaryOperator_{name}" for name in SWAPS),
    *(f"core/ReplaceComparisonOperator_{name}" for name in COMPARISONS),
    *(f"core/Replace{name}" for name in OTHERS),
    *("core/AddNot", "core/NumberReplacer", "core/ZeroIterationForLoop"),
)
"""Operators whose mutants seldom are the same program as before."""


class Mutant(NamedTuple):
    """A mutant of the library: one small change of its source.

    `module` is the file's path in the repository, `operator` Cosmic Ray's name of the change.
    `occurrence` counts the places where it can be made, from 0.
    """

    module: str
    operator: str
    occurrence: int


def all_mutants(folder: str) -> list[Mutant]:
    """Return every mutant of the modules of a folder of the library, such as "shape"."""
    from cosmic_ray import ast, plugins  # pyright: ignore[reportMissingImports]

    found = []
    for path in sorted((ROOT / "torchgrasp" / folder).rglob("*.py")):
        tree = ast.get_ast(path.read_text())
        module = path.relative_to(ROOT).as_posix()
        for name in NAMES if path.name != "__init__.py" else ():
            operator = plugins.get_operator(name)()
            nodes = ast.ast_nodes(tree)
            count = sum(len(list(operator.mutation_positions(node))) for node in nodes)
            found += [Mutant(module, name, k) for k in range(count)]
    return found


def try_mutant(copy: Path, mutant: Mutant, limit: float) -> dict[str, object]:
    """Make a mutant in a copy of the repository, run its tests, and take the change back.

    The result has the mutant's fields, the changed "line" (number, before, after), and "killed",
    whether a test failed. A run of tests longer than `limit` [s] counts as a failure.
    """
    from cosmic_ray import mutating, plugins  # pyright: ignore[reportMissingImports]

    path = copy / mutant.module
    before = path.read_text()
    operator = plugins.get_operator(mutant.operator)()
    after = mutating.mutate_code(before, operator, mutant.occurrence)
    assert after is not None
    pairs = zip(before.split("\n"), after.split("\n"), strict=False)
    lines = [
        (k, old.strip(), new.strip()) for k, (old, new) in enumerate(pairs, start=1) if old != new
    ]
    path.write_text(after)
    try:
        killed = run_tests(copy, mutant.module, limit)
    finally:
        path.write_text(before)
    return {**mutant._asdict(), "line": lines[0] if lines else None, "killed": killed}


def run_tests(copy: Path, module: str, limit: float) -> bool:
    """Run the tests of a module, then those of its folder; tell whether one fails.

    A run that takes longer than `limit` [s] counts as a failure.
    """
    inner = Path(module).relative_to("torchgrasp")
    own = copy / "tests" / inner.parent / f"test_{inner.name}"
    folder = copy / "tests" / inner.parts[0]
    environment = os.environ | {"PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1"}
    words = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-m", "not slow"]
    for tests in [own] * own.is_file() + [folder]:
        command = [*words, str(tests)]
        try:
            done = subprocess.run(
                command, cwd=copy, env=environment, capture_output=True, timeout=limit
            )
        except subprocess.TimeoutExpired:
            return True
        if done.returncode:
            return True
    return False


def main(
    out: Path,
    folders: tuple[str, ...] = ("shape", "contacts", "control", "posture_model"),
    each: int = 50,
    seed: int = 0,
    workers: int = 2,
    limit: float = 600.0,
) -> None:
    """Try a sample of the mutants of each folder; print the survivors.

    Args:
        out: JSON file; mutants that it holds are not tried again.
        folders: folders of the library.
        each: mutants of each folder, drawn at random.
        seed: of the draw.
        workers: processes.
        limit: seconds for the tests of one mutant.
    """
    chosen = list[Mutant]()
    for folder in folders:
        mutants = all_mutants(folder)
        chosen += random.Random(seed).sample(mutants, min(each, len(mutants)))
    done = json.loads(out.read_text()) if out.is_file() else []
    tried = {(one["module"], one["operator"], one["occurrence"]) for one in done}
    with tempfile.TemporaryDirectory() as scratch:
        copies = Queue[Path]()
        for k in range(workers):
            ignore = shutil.ignore_patterns(".git", ".venv", "out", "__pycache__")
            copies.put(Path(shutil.copytree(ROOT, Path(scratch, str(k)), ignore=ignore)))

        def work(mutant: Mutant) -> dict[str, object]:
            copy = copies.get()
            try:
                return try_mutant(copy, mutant, limit)
            finally:
                copies.put(copy)

        with ThreadPoolExecutor(workers) as pool:
            for result in pool.map(work, [mutant for mutant in chosen if mutant not in tried]):
                done.append(result)
                out.write_text(json.dumps(done, indent=1))
                said = "killed  " if result["killed"] else "SURVIVED"
                print(said, result["module"], result["line"], flush=True)
    survivors = [one for one in done if not one["killed"]]
    print(f"{len(survivors)} of {len(done)} mutants survived")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
