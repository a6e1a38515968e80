#!/usr/bin/env python3
"""Which tuned numbers matter: each number is moved by 20 %, and plans and closings are compared.

    .venv/bin/python scripts/sensitivity.py --objects DIR --out sensitivity.json

Numbers are the constants of modules, and the fields of options values: frozen dataclasses whose
names end in Numbers or Layout, with their default instances.

A number whose change alters no plan and no closing has no effect on these objects. It is removed,
or its reason is a case that these objects do not have. The first case that differs ends the search,
so the order of cases is that of cost.
"""

import argparse
import ast
import importlib.abc
import importlib.machinery
import importlib.util
import json
import multiprocessing
import re
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PLANNED = (
    *("geometry", "hand", "cloud", "scene", "posture_model", "shape", "contacts", "ik"),
    *("success", "planner"),
)
CLOSED = ("control", "sim", "evaluation")
"""Folders whose numbers act on plans, and on closings."""
OPTIONS = ("Numbers", "Layout")
"""Ends of the names of options values."""
SENSITIVITY = """Each constant and each field of an options value is moved by 20 %, up and then down.
It acts on plans, a scene and closings.
A number without effect here is a tolerance, a bound of memory or of a file, or serves a case that is not here."""


class Number(NamedTuple):
    """A number of the source: its module, the name of its constant or field, and its place."""

    module: str
    name: str
    line: int
    column: int


def is_number(node: ast.expr) -> bool:
    """Tell whether an expression is a number that is written out."""
    if isinstance(node, ast.UnaryOp):
        return is_number(node.operand)
    return isinstance(node, ast.Constant) and type(node.value) in (int, float)


def numbers_of(path: Path) -> Iterator[Number]:
    """Yield the numbers of a file: of its constants, and of the fields of its options values."""
    module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for owner, statement in statements_of(ast.parse(path.read_text())):
        if isinstance(statement, ast.Assign | ast.AnnAssign) and statement.value is not None:
            target = statement.targets[0] if isinstance(statement, ast.Assign) else statement.target
            for node in ast.walk(statement.value):
                if isinstance(node, ast.Constant) and is_number(node) and node.value:
                    name = owner + ast.unparse(target)
                    yield Number(module, name, node.lineno, node.col_offset)


def statements_of(tree: ast.Module) -> Iterator[tuple[str, ast.stmt]]:
    """Yield the statements of a module and of its options values, each with its owner's name."""
    for statement in tree.body:
        yield "", statement
        if isinstance(statement, ast.ClassDef) and statement.name.endswith(OPTIONS):
            for inner in statement.body:
                yield f"{statement.name}.", inner


class Moved(importlib.machinery.SourceFileLoader):
    """A loader that multiplies one number of a module."""

    number: Number
    factor: float

    def source_to_code(self, data: Any, path: Any, **_: Any) -> Any:
        """Compile the source with the number moved."""
        tree = ast.parse(data)
        for node in ast.walk(tree):
            here = (
                isinstance(node, ast.Constant) and (node.lineno, node.col_offset) == self.number[2:]
            )
            if here and isinstance(node, ast.Constant) and isinstance(node.value, int | float):
                value = node.value * self.factor
                node.value = (
                    type(node.value)(value)
                    if isinstance(node.value, float)
                    else _whole(node.value, value)
                )
        return compile(tree, path, "exec")

    def get_code(self, fullname: str) -> Any:
        """Compile anew, past the cache of byte code."""
        return self.source_to_code(self.get_data(self.path), self.path)


def _whole(old: int, new: float) -> int:
    """Return a whole number near `new` that is not `old`."""
    return round(new) if round(new) != old else old + (1 if new > old else -1)


class Finder(importlib.abc.MetaPathFinder):
    """Finds the module of the number that is moved."""

    def __init__(self, number: Number, factor: float) -> None:
        self.number = number
        self.factor = factor

    def find_spec(self, fullname: str, path: Any, target: ModuleType | None = None) -> Any:
        """Return a spec with the loader that moves the number."""
        if fullname != self.number.module:
            return None
        spec = importlib.machinery.PathFinder.find_spec(fullname, path)
        assert spec is not None and spec.origin is not None
        loader = Moved(fullname, spec.origin)
        loader.number = self.number
        loader.factor = self.factor
        return importlib.util.spec_from_file_location(fullname, spec.origin, loader=loader)


def cases(
    number: Number | None, objects: Path | None, names: list[str]
) -> Iterator[tuple[str, Callable[[], str]]]:
    """Yield the cases on which a number is tried; None: all."""
    import golden

    folder = "" if number is None else number.module.split(".")[1]
    if number is None or folder not in CLOSED:
        for view in (("jug", 1), ("spray", 3)):
            yield f"plan {view}", lambda view=view: golden.plan(*view, "allegro", "joint")
        yield "scene", plan_scene
        for name in names if objects is not None else []:
            yield f"plan {name}", lambda name=name: plan_object(objects, name)
        yield "contact first", lambda: golden.plan("cylinder", 2, "barrett", "contact_first")
        yield "paper", lambda: golden.plan("jug", 0, "barrett", "paper")
    if number is None or folder in (*CLOSED, "contacts", "geometry", "hand", "ik", "shape"):
        for how in (
            "guarded, grip",
            "uncertainty",
            "impedance",
            "paper",
            "paper position",
            "torque",
            "binary",
            "mujoco",
        ):
            yield f"close {how}", lambda how=how: golden.close("jug", "allegro", how)


def plan_scene() -> str:
    """Return the hash of the plan of a scene."""
    import golden

    from torchgrasp import load_hand, load_scene, plan_scene

    best = plan_scene(load_scene(), load_hand("allegro"), starts=30, enough=0.2).best
    return "none" if best is None or best.grasps is None else golden.hash_grasps(best.grasps)


def plan_object(objects: Any, name: str) -> str:
    """Return the hash of the plan of an object in a folder."""
    import golden

    from torchgrasp import ContactSpec, load_hand, plan_grasps
    from torchgrasp.data import read_view

    view = read_view(objects, name, "view0")
    return golden.hash_grasps(
        plan_grasps(view, load_hand("allegro"), ContactSpec(table=0.0), 80, 0)
    )


def compute(
    number: Number | None,
    factor: float,
    objects: Path | None,
    names: list[str],
    before: dict[str, str],
) -> Any:
    """Return the first case that a moved number changes; without a number, the hash of every case."""
    import torch

    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    if number is not None:
        sys.meta_path.insert(0, Finder(number, factor))
    found = {}
    try:
        for case, run in cases(number, objects, names):
            found[case] = run()
            if number is not None and found[case] != before[case]:
                return case
    except Exception as error:
        if number is None:
            raise
        return f"{type(error).__name__}: {error}"[:200]
    return None if number is not None else found


def _work(job: Any, pipe: Any) -> None:
    pipe.send(compute(*job))


def in_child(*job: Any) -> Any:
    """Run `compute` in a fork, which has loaded the large packages but nothing of torchgrasp."""
    context = multiprocessing.get_context("fork")
    mine, its = context.Pipe()
    process = context.Process(target=_work, args=(job, its))
    process.start()
    its.close()
    try:
        return mine.recv()
    except EOFError:
        return "died"
    finally:
        process.join()


def main() -> int:
    """Move each number up, and down where that changes nothing; write what changed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument(
        "--objects", type=Path, help="folder of objects with views, in which further plans are made"
    )
    parser.add_argument(
        "--names", nargs="*", default=[], help="objects of the folder that are planned on"
    )
    parser.add_argument(
        "--folders", nargs="*", default=[*PLANNED, *CLOSED], help="folders whose numbers are moved"
    )
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        help="JSON file; numbers that it holds are not tried again",
    )
    parser.add_argument(
        "--publish", action="store_true", help="write docs/results/sensitivity.md, too"
    )
    given = parser.parse_args()
    import lxml.etree  # noqa: F401
    import mujoco  # noqa: F401
    import sapien  # noqa: F401
    import scipy.optimize
    import scipy.spatial  # noqa: F401
    import skimage.measure  # noqa: F401
    import torch  # noqa: F401
    import trimesh  # noqa: F401

    before = in_child(None, 1.0, given.objects, given.names, {})
    done = json.loads(given.out.read_text()) if given.out.is_file() else {}
    paths = [
        path
        for folder in given.folders
        for path in sorted((ROOT / "torchgrasp" / folder).rglob("*.py"))
    ]
    for number in [number for path in paths for number in numbers_of(path)]:
        key = f"{number.module}:{number.line} {number.name} [{number.column}]"
        if key not in done:
            up = in_child(number, 1.2, given.objects, given.names, before)
            down = None if up else in_child(number, 0.8, given.objects, given.names, before)
            done[key] = up or down or "no effect"
            print(f"{done[key]:28} {key}", flush=True)
            given.out.write_text(json.dumps(done, indent=1))
    print(
        f"{sum(value == 'no effect' for value in done.values())} of {len(done)} numbers have no effect"
    )
    if given.publish:
        write_page(done)
    return 0


def write_page(done: dict[str, str]) -> None:
    """Write docs/results/sensitivity.md: how many numbers have an effect, and the others with their
    reason.
    """
    from benchmarks.common import describe_run

    found = [
        (*re.fullmatch(r"torchgrasp\.(\S+):(\d+) (.+) \[\d+\]", key).groups(), done[key])
        for key in done
    ]  # pyright: ignore
    every = Counter(module.split(".")[0] for module, *_ in found)
    silent = Counter(
        (module.split(".")[0], reason_of(module, int(line)))
        for module, line, _, effect in found
        if effect == "no effect"
    )
    without = Counter(folder for folder, _ in silent.elements())
    lines = ["# Numbers", "", "`scripts/sensitivity.py`", "", describe_run(1), "", SENSITIVITY, ""]
    lines += ["| folder | numbers | without effect |", "| --- | --- | --- |"]
    lines += [f"| {folder} | {n} | {without[folder]} |" for folder, n in sorted(every.items())]
    lines += ["", "| folder | numbers without effect | how many |", "| --- | --- | --- |"]
    lines += [f"| {folder} | {reason} | {n} |" for (folder, reason), n in silent.items()]
    (ROOT / "docs" / "results" / "sensitivity.md").write_text("\n".join(lines) + "\n")


def reason_of(module: str, line: int) -> str:
    """Return the comment behind or above the number at a line, or the docstring below it."""
    path = ROOT / "torchgrasp" / Path(*module.split("."))
    source = (
        (path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text().split("\n")
    )
    _, mark, comment = source[line - 1].partition("  # ")
    below = source[line].strip()
    above = source[line - 2].strip()
    if not mark:
        comment = above[2:] if above.startswith("# ") else below.strip('"')
    return comment.replace("|", "/")


if __name__ == "__main__":
    sys.exit(main())
