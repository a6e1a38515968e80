"""Modules that take long to import, or that few users need. Each is imported when one of its names
is first used. `lazy_loader` would import the parents of submodules, such as SciPy, at once.
"""

import importlib
import importlib.util
import sys
import types
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from torchgrasp.foundation.errors import MissingExtra


class _Late(types.ModuleType):
    """A stand-in for a module."""

    def __getattr__(self, name: str) -> Any:
        """Import the module, and return what it calls `name`, or the module of that name in it."""
        if name.startswith("__"):
            raise AttributeError(name)
        module = importlib.import_module(self.__name__)
        if hasattr(module, name):
            return getattr(module, name)
        return importlib.import_module(f"{self.__name__}.{name}")


class _Package(types.ModuleType):
    """A package of which single modules are used: its own start runs when another name is used."""

    def __getattr__(self, name: str) -> Any:
        """Run the start of the package, and return what it calls `name`."""
        self.__class__ = types.ModuleType  # pyright: ignore[reportAttributeAccessIssue]
        spec: Any = self.__spec__
        spec.loader.exec_module(self)
        return getattr(self, name)


class _Parts(_Late):
    """A stand-in for a package whose start imports what its modules do not need."""

    def __getattr__(self, name: str) -> Any:
        """Return the module `name` of the package, without the start of the package."""
        if name.startswith("__"):
            raise AttributeError(name)
        if self.__name__ not in sys.modules:
            spec: Any = importlib.util.find_spec(self.__name__)
            package = importlib.util.module_from_spec(spec)
            package.__class__ = _Package
            sys.modules[self.__name__] = package
        return importlib.import_module(f"{self.__name__}.{name}")


def module_late(name: str, /) -> Any:
    """Return a stand-in for the module of this full name, which is imported at its first use."""
    return _Late(name)


def import_extra(module: str, extra: str, package: str) -> Any:
    """Return a module of an optional package.

    `package` is the package's name, and `extra` the extra of torchgrasp that installs it. Raises
    `MissingExtra` if the module cannot be imported.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtra(package, extra) from error


def import_late(package: str, /, **modules: str) -> Callable[[str], Any]:
    """Return the function `__getattr__` of a package, which imports a name when it is first used.
    `modules` maps each name to the submodule of `package` that defines it.
    """

    def find(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        found = getattr(importlib.import_module(f"{package}.{modules[name]}"), name)
        setattr(sys.modules[package], name, found)
        return found

    return find


if TYPE_CHECKING:
    import jinja2 as jinja2
    import matplotlib as matplotlib
    import pytorch_kinematics.chain
    import pytorch_kinematics.frame
    import pytorch_kinematics.transforms
    import trimesh as trimesh
    import yourdfpy as yourdfpy
    from PIL import Image as Image
    from PIL import ImageDraw as ImageDraw
    from PIL import ImageFont as ImageFont
    from scipy import ndimage as ndimage
    from scipy import optimize as optimize
    from scipy import sparse as sparse
    from scipy import spatial as spatial
else:
    jinja2 = _Late("jinja2")
    matplotlib = _Late("matplotlib")
    # its start imports MuJoCo and matplotlib
    pytorch_kinematics = _Parts("pytorch_kinematics")
    trimesh = _Late("trimesh")
    yourdfpy = _Late("yourdfpy")
    Image = _Late("PIL.Image")
    ImageDraw = _Late("PIL.ImageDraw")
    ImageFont = _Late("PIL.ImageFont")
    ndimage = _Late("scipy.ndimage")
    optimize = _Late("scipy.optimize")
    sparse = _Late("scipy.sparse")
    spatial = _Late("scipy.spatial")
