"""The planner's peer, IPOPT through casadi on the same problem and posterior, and the judge of both."""

import time
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import torch
from scipy.optimize import linprog
from torch import Tensor

from torchgrasp.plan.wrench import MIN_RANK_RATIO, wrenches
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.specs import ContactSpec

LEAST_SHARE = 0.05
"""Least coefficient over that of equal ones: Eq. (13) says no more than positive, but an interior point method needs a
bound, and grasps that are closed by less are lost in the certificate's tolerance."""

Hessian = Literal["exact", "limited-memory"]


def ipopt_planner(shape: ShapeGP, spec: ContactSpec, hessian: Hessian) -> Callable[[Tensor], tuple[Tensor, float, str]]:
    """Return a function of one start (3, 3), normalised, that gives contacts, the time [s], and IPOPT's own verdict.

    The posterior is written in closed form and differentiated by casadi. Unknowns are the contacts and the
    coefficients, which begin equal. Tolerances and the limit of 3000 iterations are IPOPT's own but for that of the
    constraints, which is lowered from 1e-4 to 1e-7, as the check asks.
    """
    import casadi as ca

    points, phi = ca.MX.sym("points", 3, 3), ca.MX.sym("phi", spec.edges, 3)
    surface, variance, contacts = [], [], []
    posterior = _posterior(ca, shape)
    for i in range(3):
        distance, gradient, doubt = posterior(points[:, i])
        surface.append(distance)
        variance.append(doubt)
        contacts.append(gradient / ca.norm_2(gradient))
    wrench = 0
    plane = ca.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    for i, normal in enumerate(contacts):
        tangent = ca.cross(plane, normal)
        tangent = tangent / ca.norm_2(tangent)
        other = ca.cross(normal, tangent)
        for j in range(spec.edges):
            angle = 2 * np.pi * j / spec.edges
            force = spec.planned_friction * (np.cos(angle) * tangent + np.sin(angle) * other) - normal
            wrench += phi[j, i] * ca.vertcat(force, ca.cross(points[:, i], force))
    radius = ca.sum1(points**2).T
    constraints = ca.vertcat(*surface, wrench, ca.sum1(ca.vec(phi)) - 1, *variance, radius)
    upper = [0.0] * 10 + [spec.max_variance] * 3 + [shape.domain_radius**2] * 3
    lower = [0.0] * 10 + [-np.inf] * 6
    options: dict[str, Any] = {
        "print_time": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.hessian_approximation": hessian,
        "ipopt.constr_viol_tol": 1e-7,
    }
    unknowns = ca.vertcat(ca.vec(points), ca.vec(phi))
    objective = ca.sumsqr(ca.sum2(points) / 3)
    solver = ca.nlpsol("planner", "ipopt", {"x": unknowns, "f": objective, "g": constraints}, options)
    least = np.r_[np.full(9, -np.inf), np.full(3 * spec.edges, LEAST_SHARE / (3 * spec.edges))]

    def solve(start: Tensor) -> tuple[Tensor, float, str]:
        first = np.r_[start.numpy().ravel(), np.full(3 * spec.edges, 1 / (3 * spec.edges))]
        began = time.perf_counter() if torch.get_num_threads() > 1 else time.process_time()
        solution = solver(x0=first, lbx=least, lbg=lower, ubg=upper)
        ended = time.perf_counter() if torch.get_num_threads() > 1 else time.process_time()
        contacts = torch.from_numpy(np.array(solution["x"]).ravel()[:9].reshape(3, 3).copy())
        return contacts, ended - began, str(solver.stats()["return_status"])

    return solve


def _posterior(ca: Any, shape: ShapeGP) -> Any:
    """Return casadi's function of a point that gives mean, its gradient, and variance: the thin plate's closed form.

    With d = x - x_j and r = |d|: k = (psi - r)^2 (psi + 2 r), cov(value, normal) = 6 (psi - r) d.
    """
    x, near, n, psi = ca.MX.sym("x", 3), shape.n_oriented, len(shape.x), shape.psi
    observed = ca.DM(shape.x.T.numpy())
    a, b = ca.DM(shape.weights[:n].numpy()), ca.DM(shape.weights[n:].reshape(3, near).numpy())
    d = ca.repmat(x, 1, n) - observed
    r = ca.sqrt(ca.sum1(d**2))
    steep = 6 * (psi - r)
    row = [((psi - r) ** 2 * (psi + 2 * r)).T] + [(steep[:near] * d[m, :near]).T for m in range(3)]
    row = ca.vertcat(*row)
    along = ca.sum1(d[:, :near] * b)
    c = -steep.T * a
    c = ca.vertcat(c[:near] - 6 * (along / r[:near]).T, c[near:])
    gradient = ca.mtimes(d, c) + ca.mtimes(b, steep[:near].T)
    variance = psi**3 - ca.dot(row, ca.mtimes(ca.DM(shape.precision.numpy()), row))
    return ca.Function("posterior", [x], [ca.dot(ca.DM(shape.weights.numpy()), row), gradient, variance])


def feasible(shape: ShapeGP, spec: ContactSpec, points: Tensor) -> Tensor:
    """Tell which contacts (b, 3, 3), normalised, solve the problem: the judge of all planners, which shares no solver.

    |f_d| <= 1e-5, variance <= threshold + 1e-6, rank 6, and a margin above 1e-8 of max s: W phi = 0, sum phi = 1,
    phi >= s, by SciPy's HiGHS.
    """
    good = torch.linalg.vector_norm(points, dim=-1).amax(-1) < shape.domain_radius  # False for NaN
    estimate = shape.predict(shape.metres(torch.where(good[:, None, None], points, 0.0)))
    good &= (estimate.distance.abs() <= 1e-5).all(-1) & (estimate.variance <= spec.max_variance + 1e-6).all(-1)
    wrench = wrenches(points, estimate.normal, spec.planned_friction, spec.edges).flatten(1, 2)
    for row in torch.nonzero(good)[:, 0].tolist():
        values = torch.linalg.svdvals(wrench[row])
        good[row] = bool(values[-1] >= MIN_RANK_RATIO * values[0]) and _margin(wrench[row].numpy()) > 1e-8
    return good


def _margin(wrench: np.ndarray) -> float:
    """Return the largest s of one wrench matrix (m, 6): with phi = s + psi, psi >= 0, seven equations are left."""
    m = len(wrench)
    equations = np.zeros((7, m + 1))
    equations[:6, :m], equations[:6, m] = wrench.T, wrench.sum(0)
    equations[6, :m], equations[6, m] = 1.0, m
    bounds = [(0, None)] * m + [(None, None)]
    solution = linprog(
        np.r_[np.zeros(m), -1.0], A_eq=equations, b_eq=np.r_[np.zeros(6), 1.0], bounds=bounds, method="highs"
    )
    return -np.inf if solution.x is None else float(solution.x[m])
