"""Ellipsoids for balls and fruit: an ellipsoid, nearly a ball, is fitted to the whole cloud.

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
from torchgrasp.geometry.linalg import Points, fibonacci_sphere, unit
from torchgrasp.shape.completion.silhouette import Outlines, pick_apart

UPPER = np.triu_indices(3)  # entries of a symmetric matrix that are parameters


@dataclasses.dataclass(frozen=True)
class EllipsoidNumbers:
    """Parameters and bounds of the least-squares fit of an ellipsoid to a cloud."""

    points: int = 300
    """Greatest number of points of the cloud in the fit."""
    independent: int = 60
    """Number of points of the cloud that count as independent."""
    independent_rim: int = 8
    """Number of points of the outline that count as independent."""
    point: float = 0.001
    """Standard deviation [m] of a point of the cloud."""
    slope: float = 0.15
    """Standard deviation of a component of a unit normal."""
    rim: float = 0.002
    """Standard deviation [m] of the outline."""
    table: float = 0.001
    """Standard deviation [m] of the table's height."""
    elongation: float = 0.03
    """Standard deviation of the logarithm of an axis over the mean axis, before the fit."""
    misfit: float = 0.00165
    """Greatest RMS distance [m] of the cloud from the ellipsoid."""
    relative_misfit: float = 0.052
    """Greatest RMS distance of the cloud from the ellipsoid, over the mean radius."""
    agreement: float = 0.9
    """Least mean cosine of the cloud's normals with those of the ellipsoid."""
    longest: float = 1.5
    """Greatest ratio of two axes of the ellipsoid: a longer body is no ball."""
    spread: int = 400
    """Number of points that are spread over the whole ellipsoid."""
    step: float = 1e-5
    """Step of the ellipsoid's parameters ([m], or of a logarithm) by which the points spread over
    it are differentiated.
    """
    least_radius: float = 0.25
    """Least radius of the ball with which the fit begins, over the longest side of the cloud."""
    evaluations: int = 40
    """Greatest number of evaluations of the residuals in the fit."""
    forward: float = float(np.sqrt(np.finfo(float).eps))
    """Relative step of the residuals' finite differences: a parameter p is changed by `forward` *
    max(1, |p|).
    """


ELLIPSOID = EllipsoidNumbers()


@dataclasses.dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid fitted to a cloud, as n points spread over all of it. They are in the frame of
    the cloud.
    """

    points: Points  # n points (n, 3) [m] on the ellipsoid
    normals: Points  # outward unit normals (n, 3) at these points
    # errors [m] of the points along their normals, a column for each of 9 independent causes at one
    # standard deviation of it
    deviations: Float[Tensor, "n 9"]
    misfit: float  # RMS distance [m] of the cloud from the ellipsoid


def find_ellipsoid(
    points: Points,
    normals: Points,
    outline: Outlines,
    table: float | None,
) -> Ellipsoid | None:
    """Return the ellipsoid, nearly a ball, that fits the whole cloud, or None if there is none.

    It fits if the cloud's RMS distance from it is at most 1.65 mm (`ELLIPSOID.misfit`). It may also
    not exceed 5.2 % of the mean radius. The normals must agree, with a mean cosine of at least 0.9
    (`ELLIPSOID.agreement`). No axis may be more than 1.5 times another. `points` (n, 3) [m] and
    outward unit `normals` (n, 3) are those of the cloud, and `outline` holds its silhouettes.
    `table` is the table's height z [m]; None means no table. The body may have a flat foot: the
    ellipsoid may reach below the table, but not float above it.
    """
    rows = pick_apart(points, ELLIPSOID.points)
    fit = _Fit(points[rows].numpy(), normals[rows].numpy(), outline, table)
    parameters, covariance = fit.solve()
    one = parameters[None]
    distance, normal = fit.distance_and_normal(one)
    misfit = float(np.sqrt((distance[0] ** 2).mean()))
    agreement = float((normal[0] * fit.normals).sum(1).mean())
    axes = np.exp(np.linalg.eigvalsh(_symmetric(one[:, 3:])[0]))
    most = min(ELLIPSOID.misfit, ELLIPSOID.relative_misfit * float(axes.mean()))
    if misfit > most or agreement < ELLIPSOID.agreement or axes[2] > ELLIPSOID.longest * axes[0]:
        return None

    root = torch.from_numpy(_exponential(one[:, 3:])[0])
    direction = fibonacci_sphere(ELLIPSOID.spread)
    across = unit(direction @ torch.linalg.inv(root))
    # how the surface moves along its normals with each parameter
    near = one + ELLIPSOID.step * np.eye(9)
    moved = _support(near, across.numpy()) - _support(one, across.numpy())
    spread = torch.from_numpy(moved.T / ELLIPSOID.step @ np.linalg.cholesky(covariance))
    return Ellipsoid(torch.from_numpy(parameters[:3]) + direction @ root, across, spread, misfit)


@dataclasses.dataclass(frozen=True)
class _Fit:
    """The least-squares fit of an ellipsoid with 9 parameters.

    They are its centre [m], and 6 entries of the logarithm of a symmetric matrix. This matrix maps
    the unit ball to the ellipsoid.
    """

    points: np.ndarray
    normals: np.ndarray
    outline: Outlines
    table: float | None

    def solve(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the 9 fitted parameters and their covariance matrix."""
        # a ball by linear least squares is the first guess
        points = self.points
        rows = np.concatenate([2 * points, np.ones_like(points[:, :1])], 1)
        ball = np.linalg.lstsq(rows, (points**2).sum(1), rcond=None)[0]
        longest = np.ptp(points, axis=0).max()
        radius = np.sqrt(max(ball[3] + ball[:3] @ ball[:3], 0.0))
        radius = np.log(np.clip(radius, longest * ELLIPSOID.least_radius, longest))
        start = np.concatenate([ball[:3], radius * np.eye(3)[UPPER]])
        jacobian: Any = self.jacobian  # of which SciPy's annotations do not know
        found = optimize.least_squares(
            lambda x: self.residuals(x[None])[0],
            start,
            jacobian,
            x_scale="jac",
            loss="soft_l1",
            max_nfev=ELLIPSOID.evaluations,
        )
        return found.x, np.linalg.inv(found.jac.T @ found.jac)

    def jacobian(self, parameters: np.ndarray) -> np.ndarray:
        """Return the derivatives of the residuals by finite differences, all parameters in one
        evaluation.
        """
        step = ELLIPSOID.forward * np.maximum(1.0, np.abs(parameters))
        found = self.residuals(np.concatenate([parameters[None], parameters + np.diag(step)]))
        return ((found[1:] - found[0]) / step[:, None]).T

    def residuals(self, parameters: np.ndarray) -> np.ndarray:
        """Return residuals of points, normals, outline, table and prior over their deviations, a
        row per ellipsoid.
        """
        distance, normal = self.distance_and_normal(parameters)
        share = np.sqrt(len(self.points) / ELLIPSOID.independent)
        shape = _symmetric(parameters[:, 3:])  # (k, 3, 3)
        mean = np.trace(shape, axis1=1, axis2=2)[:, None, None] / 3
        bent = (normal - self.normals) / (ELLIPSOID.slope * share)
        longer = (shape - np.eye(3) * mean) / ELLIPSOID.elongation
        k = len(parameters)
        parts = [distance / (ELLIPSOID.point * share), bent.reshape(k, -1), longer.reshape(k, -1)]
        for view in self.outline.views:
            # the camera lies in the tangent planes of the outline
            across = view.rim_normals.numpy()
            beyond = _support(parameters, across) - across @ view.viewpoint.numpy()
            share = np.sqrt(max(len(across), 1) / ELLIPSOID.independent_rim)
            parts.append(beyond / (ELLIPSOID.rim * share))
        if self.table is not None:
            bottom = -_support(parameters, np.array([[0.0, 0.0, -1.0]])) - self.table
            parts.append(np.maximum(bottom, 0.0) / ELLIPSOID.table)
        return np.concatenate(parts, 1)

    def distance_and_normal(
        self,
        parameters: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
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


def _support(
    parameters: np.ndarray,
    across: np.ndarray,
) -> np.ndarray:
    """Return how far [m] k ellipsoids extend from the origin along m unit vectors, as (k, m)."""
    reach = across @ _exponential(parameters[:, 3:])
    return parameters[:, :3] @ across.T + _length(reach)[..., 0]


def _symmetric(entries: np.ndarray) -> np.ndarray:
    """Return the symmetric matrices with the given upper entries (k, 6)."""
    matrix = np.zeros((len(entries), 3, 3))
    row, column = UPPER
    matrix[:, row, column] = entries
    matrix[:, column, row] = entries
    return matrix


def _exponential(entries: np.ndarray) -> np.ndarray:
    """Return the matrix exponentials of symmetric matrices with the given upper entries (k, 6)."""
    values, vectors = np.linalg.eigh(_symmetric(entries))
    return vectors * np.exp(values)[:, None] @ vectors.swapaxes(1, 2)
