"""The distortion of a camera's lens: read in the forms of many drivers, and removed from the rays
of pixels.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.limits import SHOWN_LETTERS

NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Coefficients of the rational model, in the order of OpenCV and ROS."""
LISTS = (
    *("d", "distortion_coefficients", "dist_coeffs", "coeffs", "distortion"),
    *("dist", "distcoeffs", "dist_coefs", "distortion_coeffs", "distortion_coefs", "kc"),
)
"""Names of a list of coefficients, or of an object that holds them: of ROS, RealSense, Zivid,
OpenCV's examples, Kalibr and Bouguet's toolbox.
"""
OFF_CENTRE = ("codx", "cody")  # Azure Kinect's centre of distortion, 0 in its devices
MODELS = ("distortion_model", "model", "model_type", "modeltype", "camera_model")
"""Names under which drivers state which distortion model is used."""
LIKE = "distortion"
"""Text that the names of other coefficients contain, such as MATLAB's RadialDistortion."""
POLYNOMIAL = (
    *("plumb_bob", "rational_polynomial", "brown_conrady", "opencv", "radtan", "pinhole", ""),
    "calibration_lensdistortionmodelbrownconrady",
)
"""Models that OpenCV's rational polynomial covers. RealSense's inverse and modified ones differ."""
FIELDS = ("distortion_model", "model", *LISTS[1:], *NAMES, *OFF_CENTRE)
"""Names of the attributes of an object that describes a lens."""


@dataclasses.dataclass(frozen=True)
class LensNumbers:
    """Bounds of a distortion, and parameters of the search for rays."""

    straight: float = 1e-3
    """Greatest coefficient of a distortion that moves no point by more than a tenth of a pixel."""
    most: float = 1e4
    """Greatest absolute value of a coefficient: no real lens has a larger one."""
    steps: int = 20
    """Greatest number of Newton steps from a pixel to its ray."""
    still: float = 1e-6
    """Length [px] of a step at which the search for a ray ends."""
    same: float = 1e-3
    """Greatest distance [px] of the image of a found ray from its pixel."""


LENS = LensNumbers()


class Lens(NamedTuple):
    """The polynomial distortion of a lens (OpenCV's rational model).

    `coefficients` are OpenCV's k1, k2, p1, p2, k3, k4, k5 and k6, in this order, without unit.
    """

    coefficients: tuple[float, ...]

    def distort(
        self, rays: Float[Tensor, "n 2"]
    ) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 2"]]:
        """Return where n rays (x, y, 1) meet the image plane at depth 1 once the lens has bent
        them.

        `rays` (n, 2) holds x and y of the rays before the lens bends them (no unit). The second
        result holds the derivatives (n, 2, 2) of the first one. Entry (i, j) is that of coordinate
        i by ray coordinate j.
        """
        k1, k2, p1, p2, k3, k4, k5, k6 = self.coefficients
        x, y = rays.unbind(-1)
        r2 = x * x + y * y
        above = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = above / below
        above_slope = k1 + r2 * (2 * k2 + 3 * r2 * k3)
        below_slope = k4 + r2 * (2 * k5 + 3 * r2 * k6)
        slope = (above_slope - radial * below_slope) / below  # by r2
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        mixed = 2 * (x * y * slope + p1 * x + p2 * y)
        across = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
        down = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
        jacobian = torch.stack([across, mixed, mixed, down], -1).unflatten(-1, (2, 2))
        return torch.stack([u, v], -1), jacobian

    def rays(self, k: Float[Tensor, "3 3"], pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
        """Return x and y of each pixel's ray (x, y, 1), before the lens bends it.

        `pixels` (n, 2) are column and row; the result (n, 2) has no unit. `k` is the matrix of the
        intrinsics [px]. Raises `BadArgument` if a pixel lies where the polynomial is not one to
        one.
        """
        focal = torch.diagonal(k)[:2]
        seen = (pixels - k[:2, 2]) / focal
        found = seen
        for _ in range(LENS.steps):
            image, jacobian = self.distort(found)
            step = torch.linalg.solve_ex(jacobian, seen - image)[0]
            found = found + step
            if float((step * focal).abs().max()) < LENS.still:
                break
        image, jacobian = self.distort(found)
        off = ((image - seen) * focal).abs().amax(-1)
        # the polynomial folds where the determinant changes its sign
        good = (off <= LENS.same) & (torch.linalg.det(jacobian) > 0)
        good = good & (torch.diagonal(jacobian, dim1=-2, dim2=-1) > 0).all(-1)
        if not good.all():
            count = int((~good).sum())
            folded = f"a distortion {describe(self.coefficients)} that folds at {count} pixels"
            raise BadArgument("intrinsics", folded, "the coefficients of this camera, or fewer")
        return found


def describe(coefficients: object) -> str:
    """Return the coefficients of a distortion as text, cut off if it is long."""
    return str(coefficients)[:SHOWN_LETTERS]


def numbers_of(value: object) -> list[float]:
    """Return the numbers of a matrix or a list row by row; an empty list for anything else."""
    if value is None:
        return []
    try:
        return np.asarray(value, dtype=np.float64).ravel().tolist()
    except (TypeError, ValueError):
        return []


def read_lens(named: Mapping[str, Any]) -> Lens | None:
    """Return the distortion of a camera, given the values that a driver states, by name; None if
    there is hardly any.

    Names are in lower case. There is hardly any if no coefficient exceeds 0.001 (`LENS.straight`).
    Raises `BadArgument` for a model that is no rational polynomial, such as a fisheye's. Raises it
    also for fewer than 4 coefficients in a list, or one other than 0 after the eighth. The same is
    raised for a coefficient that is not below 10,000 (`LENS.most`).
    """
    lists = [named[name] for name in LISTS if named.get(name) is not None]
    found = {name: named[name] for name in (*NAMES, *OFF_CENTRE) if named.get(name) is not None}
    values = list[float]()
    for value in lists:
        if isinstance(value, Mapping):
            inner = {str(name).lower(): x for name, x in value.items()}
            values += numbers_of(inner.pop("data", None))
            found |= inner
        else:
            values += numbers_of(value)
    by_name = {name: numbers_of(found.get(name)) for name in (*NAMES, *OFF_CENTRE)}
    given = {name: x[0] for name, x in by_name.items() if x}
    every = [*values, *given.values()]
    for other, value in named.items():
        known = other in (*LISTS, *MODELS) or isinstance(value, bool)
        if LIKE in other and not known and any(numbers_of(value)):
            bent = f"{other[:SHOWN_LETTERS]} {describe(value)}, which is not read"
            raise BadArgument("intrinsics", bent, "distortion as D, in the order k1 k2 p1 p2 k3")
    # NaN is no small number
    if all(abs(x) <= LENS.straight for x in every):
        return None
    shown = f"distortion {describe(given or values)}"
    model = next((named[name] for name in MODELS if named.get(name) is not None), None)
    # pyrealsense2's enumeration is distortion.brown_conrady
    name = str(model if model is not None else "").lower().rsplit(".", 1)[-1].replace(" ", "_")
    allowed = "plumb_bob or rational_polynomial; of another model, first rectify the image"
    if name not in POLYNOMIAL or (model is None and "coeffs" in named):
        what = f"the model {name[:SHOWN_LETTERS]}" if model is not None else "no model"
        raise BadArgument("intrinsics", f"{shown} of {what}", allowed)
    off_centre = any(given.get(name) for name in OFF_CENTRE)
    beyond = any(values[len(NAMES) :]) or off_centre
    known = all(math.isfinite(x) and abs(x) < LENS.most for x in every)
    if beyond or not known or (values and given) or len(values) in (1, 2, 3):
        raise BadArgument("intrinsics", shown, "at most k1 k2 p1 p2 k3 k4 k5 k6")
    if values:
        given = dict(zip(NAMES, values, strict=False))
    return Lens(tuple(given.get(name, 0.0) for name in NAMES))
