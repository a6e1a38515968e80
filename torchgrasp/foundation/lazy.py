"""Modules that take long to import, or that few users need: each is imported when one of its names
is first used. `lazy_loader` would import the parents of submodules, such as SciPy, at once.
"""

import importlib
import types
from typing import TYPE_CHECKING, Any


class _Late(types.ModuleType):
    """A stand-in for a module."""

    def __getattr__(self, name: str) -> Any:
        """Import the module, and return what it calls `name`, or the module of that name in it."""
        if name.startswith("__"):
            raise AttributeError(name)
        module = importlib.import_module(self.__name__)
        return (
            getattr(module, name)
            if hasattr(module, name)
            else importlib.import_module(f"{self.__name__}.{name}")
        )


if TYPE_CHECKING:
    import jinja2 as jinja2
    import matplotlib as matplotlib
    import pytorch_kinematics as pytorch_kinematics
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
    pytorch_kinematics = _Late("pytorch_kinematics")
    trimesh = _Late("trimesh")
    yourdfpy = _Late("yourdfpy")
    Image = _Late("PIL.Image")
    ImageDraw = _Late("PIL.ImageDraw")
    ImageFont = _Late("PIL.ImageFont")
    ndimage = _Late("scipy.ndimage")
    optimize = _Late("scipy.optimize")
    sparse = _Late("scipy.sparse")
    spatial = _Late("scipy.spatial")
