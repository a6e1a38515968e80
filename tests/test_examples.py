"""Every public name has an example that runs: the doctests of the suite run all that stand in docstrings."""

import dataclasses
import importlib
import inspect
import pkgutil
import re
from types import ModuleType
from typing import Any

import torchgrasp

SHOWN_BY = {
    "torchgrasp.closure.ClosingTrace": "torchgrasp.evaluation.lift.close_hand",
    "torchgrasp.closure.ClosureResult": "torchgrasp.evaluation.lift.close_hand",
    "torchgrasp.closure.Disturbance": "torchgrasp.evaluation.lift.close_hand",
    "torchgrasp.data.reader.GraspShards": "torchgrasp.data.reader.read_shards",
    "torchgrasp.data.reader.ShardJob": "torchgrasp.data.reader.read_shards",
    "torchgrasp.hand.urdf.Joint": "torchgrasp.hand.urdf.read_urdf",
    "torchgrasp.hand.urdf.Link": "torchgrasp.hand.urdf.read_urdf",
    "torchgrasp.hand.urdf.Mimic": "torchgrasp.hand.urdf.read_urdf",
    "torchgrasp.hand.urdf.Shape": "torchgrasp.hand.urdf.read_urdf",
    "torchgrasp.shape.posterior.SurfaceJet": "torchgrasp.plan.problem.Shape",
    "torchgrasp.values.Certificate": "torchgrasp.plan.certify.certify",
    "torchgrasp.values.ContactCode": "torchgrasp.posture_model.encoding.encode",
    "torchgrasp.values.ContactPlan": "torchgrasp.plan.solve.plan_contacts",
    "torchgrasp.values.IKSeeds": "torchgrasp.ik.seeds.nearest_postures",
    "torchgrasp.values.ShapeEstimate": "torchgrasp.shape.gp.ShapeGP",
}
"""Values that the library alone makes, and what makes them: its example reads one of their fields."""


def examples(thing: Any) -> str:
    """The lines of the examples in a docstring, those of a class's public members with them."""
    members = [vars(thing)[name] for name in vars(thing) if not name.startswith("_")] if inspect.isclass(thing) else []
    members = [getattr(m, "func", None) or getattr(m, "__func__", m) for m in members]
    texts = [thing.__doc__, *(m.__doc__ for m in members if callable(m) or isinstance(m, property))]
    return "\n".join(line for text in texts for line in re.findall(r"^ *(?:>>>|\.\.\.) .*", text or "", re.MULTILINE))


def public() -> dict[str, Any]:
    """Functions and classes of every public package, by the place of their definition."""
    packages = [torchgrasp]
    for found in pkgutil.walk_packages(torchgrasp.__path__, "torchgrasp."):
        packages += [importlib.import_module(found.name)] if found.ispkg else []
    things = [getattr(package, name) for package in packages for name in getattr(package, "__all__", ())]
    return {f"{x.__module__}.{x.__qualname__}": x for x in things if inspect.isfunction(x) or inspect.isclass(x)}


def of_module(module: ModuleType) -> str:
    """The examples of all functions and classes that a module defines."""
    mine = [x for x in vars(module).values() if getattr(x, "__module__", "") == module.__name__]
    return "\n".join(examples(x) for x in mine if inspect.isfunction(x) or inspect.isclass(x))


def find(name: str) -> Any:
    """A function, class or method by the place of its definition."""
    module, _, last = name.rpartition(".")
    try:
        return getattr(importlib.import_module(module), last)
    except ModuleNotFoundError:
        return getattr(find(module), last)


def test_every_public_function_and_class_has_an_example():
    silent = []
    for name, thing in public().items():
        if inspect.isclass(thing):
            shown = examples(thing) or name in SHOWN_BY
        else:
            shown = re.search(rf"\b{thing.__name__}\b", examples(thing))
        silent += [] if shown else [name]
    assert silent == []


def test_every_public_method_is_called_in_an_example_of_its_module():
    """One that overrides another's is shown by that."""
    silent = []
    for name, thing in public().items():
        if not inspect.isclass(thing):
            continue
        above = {key for base in thing.__mro__[1:] for key in vars(base)}
        for key, value in vars(thing).items():
            own = inspect.isfunction(value) or isinstance(value, classmethod | staticmethod)
            if own and not key.startswith("_") and key not in above:
                calls = of_module(importlib.import_module(thing.__module__))
                silent += [] if re.search(rf"\.{key}\(", calls) else [f"{name}.{key}"]
    assert silent == []


def test_what_makes_a_value_reads_one_of_its_fields():
    for name, maker in SHOWN_BY.items():
        kind = find(name)
        names = [f.name for f in dataclasses.fields(kind)] if dataclasses.is_dataclass(kind) else list(kind._fields)
        assert re.search(rf"\.({'|'.join(names)})\b", examples(find(maker))), (name, maker)
