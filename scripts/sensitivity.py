#!/usr/bin/env python3
"""Which tuned numbers matter: each number is moved by 20 %, and plans and closings are compared.

    .venv/bin/python scripts/sensitivity.py --objects DIR --out sensitivity.json

Numbers are the constants of modules, and the fields of options values. These are frozen dataclasses
whose names end in Numbers or Layout, with their default instances.

A number whose change alters no plan and no closing has no effect on these objects. It is removed,
or its reason is a case that these objects do not have. The first case that differs ends the search
for a number, so the order of cases is that of cost. Where few numbers have an effect, several are
moved at once.
"""

import ast
import importlib.abc
import importlib.machinery
import importlib.util
import json
import multiprocessing
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import tyro

ROOT = Path(__file__).resolve().parents[1]
PLANNED = (
    *("geometry", "hand", "cloud", "scene", "posture_model", "shape", "contacts", "ik"),
    *("success", "planner"),
)
CLOSED = ("control", "sim", "evaluation")
"""Folders whose numbers act on plans, and on closings."""
OPTIONS = ("Numbers", "Layout")
"""Ends of the names of options values."""
FACTORS = (1.2, 0.8)
"""Factors by which a number is moved."""
TOGETHER = 32
"""Most numbers that are moved at once, where few have an effect."""
WAYS = (
    *("guarded, grip", "uncertainty", "impedance", "paper", "paper position"),
    *("torque", "binary", "mujoco"),
)
"""Ways to close a hand, of those of `golden.py`."""


class Number(NamedTuple):
    """A number that stands in the library's source.

    `module` is the dotted name, `name` that of the constant or field that holds the number. `line`
    counts from 1, `column` from 0.
    """

    module: str
    name: str
    line: int
    column: int

    @property
    def key(self) -> str:
        """The number's place and name, as they stand in the JSON file."""
        return f"{self.module}:{self.line} {self.name} [{self.column}]"


class Case(NamedTuple):
    """A case on which numbers are tried: its name, and a function that returns its hash."""

    name: str
    run: Callable[[], str]


def is_number(node: ast.expr) -> bool:
    """Tell whether an expression is a literal number, perhaps with a sign."""
    if isinstance(node, ast.UnaryOp):
        return is_number(node.operand)
    return isinstance(node, ast.Constant) and type(node.value) in (int, float)


def numbers_of(path: Path) -> Iterator[Number]:
    """Yield the numbers in a file that are not 0: of its constants and of its options values.

    Options values are the dataclasses whose names end in Numbers or Layout.
    """
    module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for owner, statement in statements_of(ast.parse(path.read_text())):
        if isinstance(statement, ast.Assign | ast.AnnAssign) and statement.value is not None:
            target = statement.targets[0] if isinstance(statement, ast.Assign) else statement.target
            for node in ast.walk(statement.value):
                if isinstance(node, ast.Constant) and is_number(node) and node.value:
                    name = owner + ast.unparse(target)
                    yield Number(module, name, node.lineno, node.col_offset)


def statements_of(tree: ast.Module) -> Iterator[tuple[str, ast.stmt]]:
    """Yield (owner, statement) for the statements of a module and of its options values.

    The owner is "" for the module, and "CLASS." for an options value.
    """
    for statement in tree.body:
        yield "", statement
        if isinstance(statement, ast.ClassDef) and statement.name.endswith(OPTIONS):
            for inner in statement.body:
                yield f"{statement.name}.", inner


class Moved(importlib.machinery.SourceFileLoader):
    """A loader of modules that multiplies some `numbers` of the source by a `factor`."""

    numbers: Sequence[Number]
    factor: float

    def source_to_code(self, data: Any, path: Any, **_: Any) -> Any:
        """Return the compiled source `data`, in which the numbers are multiplied by the factor."""
        tree = ast.parse(data)
        places = {(number.line, number.column) for number in self.numbers}
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and (node.lineno, node.col_offset) in places:
                node.value = moved(node.value, self.factor)
        return compile(tree, path, "exec")

    def get_code(self, fullname: str) -> Any:
        """Return the code of the module, compiled anew without the cache of byte code."""
        return self.source_to_code(self.get_data(self.path), self.path)


def moved(value: Any, factor: float) -> Any:
    """Return a number times a factor; a whole number is rounded, and changes by at least 1."""
    if isinstance(value, float):
        return value * factor
    near = round(value * factor)
    return near if near != value else value + (1 if factor > 1 else -1)


class Finder(importlib.abc.MetaPathFinder):
    """An import hook that loads the modules of some numbers with these multiplied by a factor."""

    def __init__(self, numbers: Sequence[Number], factor: float) -> None:
        self.numbers = numbers
        self.factor = factor

    def find_spec(self, fullname: str, path: Any, target: ModuleType | None = None) -> Any:
        """Return the import spec of a module with a `Moved` loader; None if it has no number."""
        numbers = [number for number in self.numbers if number.module == fullname]
        if not numbers:
            return None
        spec = importlib.machinery.PathFinder.find_spec(fullname, path)
        assert spec is not None and spec.origin is not None
        loader = Moved(fullname, spec.origin)
        loader.numbers = numbers
        loader.factor = self.factor
        return importlib.util.spec_from_file_location(fullname, spec.origin, loader=loader)


def cases_of(folder: str, objects: Path | None, names: Sequence[str]) -> Iterator[Case]:
    """Yield the cases on which the numbers of a folder of the library are tried, cheapest first.

    `names` are further objects to plan on, in the folder `objects`; None means no such objects.
    """
    import golden

    if folder in ("geometry", "cloud", "scene"):
        yield Case("depth image", see_scene)
    if folder in ("contacts", "shape"):
        yield Case("probabilities", find_probabilities)
    if folder not in CLOSED:
        for view in (("jug", 1), ("spray", 3)):
            yield Case(f"plan {view}", partial(golden.plan, *view, "allegro", "joint"))
        for name in names if objects is not None else ():
            yield Case(f"plan {name}", partial(plan_object, objects, name))
        yield Case("scene", plan_scene)
        yield Case("contact first", partial(golden.plan, "cylinder", 2, "barrett", "contact_first"))
        yield Case("paper", partial(golden.plan, "jug", 0, "barrett", "paper"))
    if folder in (*CLOSED, "contacts", "geometry", "hand", "ik", "shape"):
        for how in WAYS:
            yield Case(f"close {how}", partial(golden.close, "jug", "allegro", how))


def see_scene() -> str:
    """Return the hash of the table and the objects that are found in the shipped depth image."""
    import golden

    from torchgrasp import Scene, load_scene

    image = load_scene().image
    seen = Scene.from_depth(image.depth, image.intrinsics, image.obj_from_camera)
    advice = " ".join((*seen.notes, *seen.advice))
    return golden.digest(str(seen.table), seen.labels, str(seen.noise), advice)


def find_probabilities() -> str:
    """Return the hash of a shipped grasp's probabilities of closure and of holding."""
    import golden

    import torchgrasp as tg
    from torchgrasp.data.shipped import load_shipped_grasp

    contacts = load_shipped_grasp("jug", "allegro").contacts
    shape = tg.fit_shape(tg.load_object("jug").view, table=0.0)
    friction = tg.Distribution.between(0.2, 1.0)
    mass = tg.Distribution.between(0.1, 0.5)
    weight = tg.CarriedWeight(mass, contacts.points[0].mean(0), press=4.0)
    closed = tg.closure_probability(shape, contacts).probability
    needed = tg.critical_friction(contacts.points, contacts.normals)
    held = tg.hold_probability(contacts, friction, placement=0.002, tilt=0.05, weight=weight)
    return golden.digest(closed, needed, held)


def plan_scene() -> str:
    """Return the hash of the best grasps that are planned in the shipped scene; "none" without."""
    import golden

    from torchgrasp import load_hand, load_scene, plan_scene

    best = plan_scene(load_scene(), load_hand("allegro"), starts=30, enough=0.2).best
    return "none" if best is None or best.grasps is None else golden.hash_grasps(best.grasps)


def plan_object(objects: Any, name: str) -> str:
    """Return the hash of the grasps that are planned on the first view of an object in a folder."""
    import golden

    from torchgrasp import ContactSpec, load_hand, plan_grasps
    from torchgrasp.data import read_view

    view = read_view(objects, name, "view0")
    grasps = plan_grasps(view, load_hand("allegro"), ContactSpec(table=0.0), 80, 0)
    return golden.hash_grasps(grasps)


def compute(numbers: Sequence[Number], factor: float, case: Case) -> str:
    """Return the hash of a case in a library whose `numbers` are multiplied by `factor`.

    An error gives its text in place of the hash. Without numbers it is raised.
    """
    import torch

    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    if numbers:
        sys.meta_path.insert(0, Finder(numbers, factor))
    try:
        return case.run()
    except Exception as error:
        if not numbers:
            raise
        return f"{type(error).__name__}: {error}"[:200]


def _work(job: Any, pipe: Any) -> None:
    pipe.send(compute(*job))


def in_child(*job: Any) -> str:
    """Run `compute` with the arguments `job` in a child process, and return its result.

    The child has loaded the large packages but nothing of torchgrasp. A child that dies gives
    "died".
    """
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


def that_change(numbers: Sequence[Number], factor: float, case: Case, before: str) -> list[Number]:
    """Return the numbers whose move by a factor changes the hash `before` of a case.

    Groups that change nothing grow to `TOGETHER`; a group that changes the hash is tried again in
    smaller ones.
    """
    found = list[Number]()
    left = list(numbers)
    size = 1
    while left:
        group = left[:size]
        left = left[size:]
        if in_child(group, factor, case) == before:
            size = min(2 * size, TOGETHER)
        elif len(group) == 1:
            found += group
        else:
            left = group + left
            size //= 2
    return found


def try_folder(folder: str, objects: Path | None, names: Sequence[str]) -> dict[str, str]:
    """Return for each number of a folder the name of the first case that it changes.

    Numbers are by `Number.key`; one that changes no case has "no effect".
    """
    paths = sorted((ROOT / "torchgrasp" / folder).rglob("*.py"))
    numbers = [number for path in paths for number in numbers_of(path)]
    found = {}
    for case in cases_of(folder, objects, names):
        before = in_child([], 1.0, case)
        for factor in FACTORS:
            left = [number for number in numbers if number not in found]
            for number in that_change(left, factor, case, before):
                found[number] = case.name
                print(f"{case.name:28} {number.key}", flush=True)
    return {number.key: found.get(number, "no effect") for number in numbers}


def main(
    out: Path,
    objects: Path | None = None,
    names: tuple[str, ...] = (),
    folders: tuple[str, ...] = (*PLANNED, *CLOSED),
) -> None:
    """Move the numbers of each folder up and down; write what changed.

    Args:
        out: JSON file; folders that it holds are not tried again.
        objects: folder of objects with views, in which further plans are made.
        names: objects of this folder that are planned on.
        folders: folders of the library whose numbers are moved.
    """
    import lxml.etree  # noqa: F401
    import mujoco  # noqa: F401
    import sapien  # noqa: F401
    import scipy.optimize
    import scipy.spatial  # noqa: F401
    import skimage.measure  # noqa: F401
    import torch  # noqa: F401
    import trimesh  # noqa: F401

    done = json.loads(out.read_text()) if out.is_file() else {}
    for folder in folders:
        if not any(key.split(".")[1] == folder for key in done):
            done |= try_folder(folder, objects, names)
            out.write_text(json.dumps(done, indent=1))
    silent = sum(value == "no effect" for value in done.values())
    print(f"{silent} of {len(done)} numbers have no effect")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
