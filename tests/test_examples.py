"""Every public function has an example that runs: the doctests of the suite run all that stand in docstrings."""

import importlib
import inspect
import pkgutil
import re
from typing import Any

import torchgrasp


def public() -> dict[str, Any]:
    """The public functions of every package, by the place of their definition."""
    packages = [torchgrasp]
    for found in pkgutil.walk_packages(torchgrasp.__path__, "torchgrasp."):
        packages += [importlib.import_module(found.name)] if found.ispkg else []
    things = [getattr(package, name) for package in packages for name in getattr(package, "__all__", ())]
    return {f"{x.__module__}.{x.__qualname__}": x for x in things if inspect.isfunction(x)}


def test_every_public_function_has_an_example_that_calls_it():
    silent = []
    for name, function in public().items():
        lines = "\n".join(re.findall(r"^ *(?:>>>|\.\.\.) .*", function.__doc__ or "", re.MULTILINE))
        silent += [] if re.search(rf"\b{function.__name__}\b", lines) else [name]
    assert silent == []
