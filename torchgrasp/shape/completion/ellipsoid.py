"""Balls and fruit: an ellipsoid, nearly a ball, is fitted to the whole cloud.

Every plane through the centre of a ball is a mirror plane, so mirror planes do not determine its
depth. The ellipsoid does: the fit uses normals, outline and table, and its covariance gives the
uncertainty.
"""

import dataclasses
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.lazy import optimize
from torchgrasp.geometry.linalg import Points, farthest_points, fibonacci_sphere, unit
from torchgrasp.shape.completion.silhouette import TIE, Outlines

# points of the cloud and the outline that count as independent
INDEPENDENT = 60
INDEPENDENT_RIM = 8
POINT_NOISE = 0.001
SLOPE_NOISE = 0.15
RIM_NOISE = 0.002
TABLE_NOISE = 0.001
"""Standard deviations of a point [m], of its normal, of the outline [m] and of the table [m]."""
ELONGATION = 0.03  # standard deviation of the logarithm of an axis over the mean axis
# greatest RMS distance of the cloud, in metres and in mean radii
MAX_MISFIT = 0.00165
MAX_RELATIVE_MISFIT = 0.052
FORWARD = float(
    np.sqrt(np.finfo(float).eps)
)  # step of the finite differences, over a parameter or 1
UPPER = np.triu_indices(3)  # entries of a symmetric matrix that are parameters


@dataclasses.dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid fitted to a cloud: points [m] and normals spread over all of it."""

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    deviations: Float[
        Tensor, "n 9"
    ]  # standard deviations [m] along the normals, one column per independent error
    misfit: float  # RMS distance [m] of the cloud from the ellipsoid


def find_ellipsoid(
    points: Points, normals: Points, outline: Outlines, table: float | None
) -> Ellipsoid | None:
    """Return the ellipsoid, nearly a ball, that fits the whole cloud, or None if there is none.

    The body may have a flat foot: the ellipsoid may reach below the table, but not float above it.
    """
    rows = farthest_points(points, 300, tie=TIE)
    fit = _Fit(points[rows].numpy(), normals[rows].numpy(), outline, table)
    parameters, covariance = fit.solve()
    one = parameters[None]
    axes = np.exp(np.linalg.eigvalsh(_symmetric(one[:, 3:])[0]))
    distance, normal = (x[0] for x in fit.distance_and_normal(one))
    misfit = float(np.sqrt((distance**2).mean()))
    agreement = float((normal * fit.normals).sum(1).mean())
    if misfit > min(MAX_MISFIT, MAX_RELATIVE_MISFIT * float(axes.mean())) or agreement < 0.9:
        return None
    if axes[2] > 1.5 * axes[0]:
        return None
    root = torch.from_numpy(_exponential(one[:, 3:])[0])
    direction = fibonacci_sphere(400)
    across = unit(direction @ torch.linalg.inv(root))
    moved = _support(one + 1e-5 * np.eye(9), across.numpy()) - _support(one, across.numpy())
    spread = torch.from_numpy(moved.T / 1e-5 @ np.linalg.cholesky(covariance))
    return Ellipsoid(torch.from_numpy(parameters[:3]) + direction @ root, across, spread, misfit)


@dataclasses.dataclass(frozen=True)
class _Fit:
    """The least-squares fit of an ellipsoid with 9 parameters.

    They are its centre [m], and 6 entries of the logarithm of the symmetric matrix that maps the
    unit ball to it.
    """

    points: np.ndarray
    normals: np.ndarray
    outline: Outlines
    table: float | None

    def solve(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the 9 fitted parameters and their covariance matrix."""
        rows = np.concatenate([2 * self.points, np.ones_like(self.points[:, :1])], 1)
        ball = np.linalg.lstsq(rows, (self.points**2).sum(1), rcond=None)[0]
        longest = np.ptp(self.points, axis=0).max()
        radius = np.log(
            np.clip(np.sqrt(max(ball[3] + ball[:3] @ ball[:3], 0.0)), longest / 4, longest)
        )
        start = np.concatenate([ball[:3], radius * np.eye(3)[UPPER]])
        jacobian: Any = self.jacobian  # of which SciPy's annotations do not know
        options: Any = {"x_scale": "jac", "loss": "soft_l1", "max_nfev": 40}
        found = optimize.least_squares(
            lambda x: self.residuals(x[None])[0], start, jacobian, **options
        )
        return found.x, np.linalg.inv(found.jac.T @ found.jac)

    def jacobian(self, parameters: np.ndarray) -> np.ndarray:
        """Return the derivatives of the residuals by finite differences, all parameters in one
        evaluation.
        """
        step = FORWARD * np.maximum(1.0, np.abs(parameters))
        found = self.residuals(np.concatenate([parameters[None], parameters + np.diag(step)]))
        return ((found[1:] - found[0]) / step[:, None]).T

    def residuals(self, parameters: np.ndarray) -> np.ndarray:
        """Return residuals of points, normals, outline, table and prior over their deviations, a
        row per ellipsoid.
        """
        distance, normal = self.distance_and_normal(parameters)
        share = np.sqrt(len(self.points) / INDEPENDENT)
        k = len(parameters)
        shape = _symmetric(parameters[:, 3:])
        mean = np.trace(shape, axis1=1, axis2=2)[:, None, None] / 3
        parts = [
            distance / (POINT_NOISE * share),
            ((normal - self.normals) / (SLOPE_NOISE * share)).reshape(k, -1),
            ((shape - np.eye(3) * mean) / ELONGATION).reshape(k, -1),
        ]
        for view in self.outline.views:
            across = (
                view.rim_normals.numpy()
            )  # the camera lies in the tangent planes of the outline
            beyond = _support(parameters, across) - across @ view.viewpoint.numpy()
            parts.append(beyond / (RIM_NOISE * np.sqrt(max(len(across), 1) / INDEPENDENT_RIM)))
        if self.table is not None:
            bottom = -_support(parameters, np.array([[0.0, 0.0, -1.0]])) - self.table
            parts.append(np.maximum(bottom, 0.0) / TABLE_NOISE)
        return np.concatenate(parts, 1)

    def distance_and_normal(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the first-order distance [m] of the points from k ellipsoids, and the ellipsoids'
        normals there.
        """
        inverse = _exponential(-parameters[:, 3:])
        local = (self.points - parameters[:, None, :3]) @ inverse
        length = _length(local)
        slope = local @ inverse / length
        steep = _length(slope)
        return ((length - 1.0) / steep)[..., 0], slope / steep


def _length(vectors: np.ndarray) -> np.ndarray:
    """Return the length of each vector along the last axis, which keeps size 1."""
    return np.sqrt(np.einsum("...i,...i->...", vectors, vectors))[..., None]


def _support(parameters: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Return how far [m] k ellipsoids extend from the origin along m unit vectors, as (k, m)."""
    reach = across @ _exponential(parameters[:, 3:])
    return parameters[:, :3] @ across.T + _length(reach)[..., 0]


def _symmetric(entries: np.ndarray) -> np.ndarray:
    """Return the symmetric matrices with the given upper entries (k, 6)."""
    matrix = np.zeros((len(entries), 3, 3))
    matrix[:, UPPER[0], UPPER[1]] = matrix[:, UPPER[1], UPPER[0]] = entries
    return matrix


def _exponential(entries: np.ndarray) -> np.ndarray:
    """Return the matrix exponentials of symmetric matrices with the given upper entries (k, 6)."""
    values, vectors = np.linalg.eigh(_symmetric(entries))
    return vectors * np.exp(values)[:, None] @ vectors.swapaxes(1, 2)
