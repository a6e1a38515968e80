"""Random contacts, many at the border of closure, and verdicts on them in rational arithmetic: what
is proven here is not subject to rounding.

The wrenches are written anew from Eq. (13) and rounded to multiples of 2^-60, which is finer than
their own rounding; from there on all is exact. A proof needs no trust in who proposes it.
"""

from fractions import Fraction
from itertools import combinations

import numpy as np
import torch

from torchgrasp.contacts.form_closure import MIN_MARGIN, solve_closure_lp, wrenches
from torchgrasp.geometry.linalg import unit
from torchgrasp.values.planning import Contacts
from torchgrasp.values.specs import ContactSpec

GRID = 60
"""Wrenches are integers over 2 to this power, witnesses and coefficients over 2 to the power of 50.
"""
TOLERANCES = ("primal_feasibility_tolerance", "dual_feasibility_tolerance")
NEAR_BASIS = 10
"""The largest coefficients of HiGHS among which a feasible basis is sought."""


def random_contacts(
    count: int, generator: torch.Generator, lean: float = 0.45, fingertips: int = 3
) -> Contacts:
    """Return random contacts with normals that lean away from their centre; the smaller `lean`, the
    more are closed.
    """
    points, noise = (
        torch.randn(count, fingertips, 3, generator=generator, dtype=torch.float64)
        for _ in range(2)
    )
    return Contacts(points, unit(unit(points - points.mean(1, keepdim=True)) + lean * noise))


def border_contacts(
    count: int, fingertips: int, spec: ContactSpec, generator: torch.Generator
) -> Contacts:
    """Return random contacts; the normals of every second one are turned to the border of closure
    and a little on.
    """
    contacts = random_contacts(count, generator, fingertips=fingertips)
    half = count // 2
    points = contacts.points[:half]
    far = contacts.normals[:half]
    near = unit(points - points.mean(1, keepdim=True))
    low = torch.zeros(half, 1, 1, dtype=torch.float64)
    high = torch.full((half, 1, 1), 2.0, dtype=torch.float64)
    for _ in range(45):
        middle = (low + high) / 2
        wrench = wrenches(
            points, unit(near + middle * (far - near)), spec.planned_friction, spec.edges
        )
        closed = (solve_closure_lp(wrench.flatten(1, 2))[0].amin(1) >= MIN_MARGIN)[:, None, None]
        low = torch.where(closed, middle, low)
        high = torch.where(closed, high, middle)
    step = 10 ** (-3 - 7 * torch.rand(half, 1, 1, generator=generator, dtype=torch.float64))
    sign = torch.sign(torch.randn(half, 1, 1, generator=generator, dtype=torch.float64))
    turned = unit(near + (low + sign * step) * (far - near))
    return Contacts(contacts.points, torch.cat([turned, contacts.normals[half:]]))


def wrench_matrix(
    points: np.ndarray, normals: np.ndarray, friction: float, edges: int
) -> np.ndarray:
    """Return the m x 6 wrenches of contacts with outward normals, from the definition, as integers.

    The first edge of each cone leans along the plane of three contacts that it leans most against,
    as the library's does. Torques are about the centre, over the root-mean-square distance from it.
    """
    arm = points - points.mean(0)
    arm = arm / np.sqrt((arm**2).sum() / len(points))
    planes = [np.cross(q - p, r - p) for p, q, r in combinations(points, 3)]
    rows = []
    for p, n in zip(arm, normals, strict=True):
        along = max((np.cross(plane, n) for plane in planes), key=np.linalg.norm)
        along = along / np.linalg.norm(along)
        across = np.cross(n, along)
        for k in range(edges):
            turn = 2 * np.pi * k / edges
            force = friction * (np.cos(turn) * along + np.sin(turn) * across) - n
            rows.append(np.concatenate([force, np.cross(p, force)]))
    return _integers(np.array(rows), GRID)


def has_low_rank(points: np.ndarray, normals: np.ndarray, friction: float, edges: int) -> bool:
    """Tell whether wrenches written anew lack rank, or their largest triangle is flat, to the
    library's thresholds.
    """
    values = np.linalg.svd(
        wrench_matrix(points, normals, friction, edges).astype(float), compute_uv=False
    )
    corners = points[list(combinations(range(len(points)), 3))]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1
    ).max()
    longest = max(((p - q) ** 2).sum() for p, q in combinations(points, 2))
    return bool(values[-1] < 1.001e-3 * values[0] or area < 1.001e-3 * longest)


def proves_margin_below(wrench: np.ndarray, witness: np.ndarray, bound: Fraction) -> bool:
    """Tell whether a wrench proves that no balance has a margin of `bound`.

    With g the products of the witness with the wrenches, 0 = sum phi g >= s sum g + (1 - m s) min g
    for phi >= s.
    """
    product = wrench @ _integers(witness, 50)
    least = min(product)
    return -least < bound * sum(g - least for g in product)


def proves_margin_above(wrench: np.ndarray, phi: np.ndarray, bound: Fraction) -> bool:
    """Tell whether coefficients near `phi` balance exactly with a margin above `bound`, by six of
    full rank.
    """
    m = len(wrench)
    integers = _integers(phi, 50)
    base = sorted(range(m), key=lambda k: -phi[k])[:6]
    rest = [k for k in range(m) if k not in set(base)]
    solved = solve(wrench[base].T, -(wrench[rest].T @ integers[rest]))
    if solved is None:
        return False
    exact = [*solved, *(Fraction(int(integers[k])) for k in rest)]
    return min(exact) > bound * sum(exact)


def exact_margin(wrench: np.ndarray) -> Fraction:
    """Return the largest s of W phi = 0, sum phi = 1, phi >= s as a fraction: a simplex method
    begun where HiGHS ends.

    Raises:
        ArithmeticError: no coefficients balance, or the basis of HiGHS is not feasible.
    """
    from scipy.optimize import linprog

    m = len(wrench)
    matrix = wrench.astype(np.float64) / 2.0**GRID
    # phi = s + psi: seven equations in psi >= 0 and s.
    equations = np.zeros((7, m + 1))
    equations[:6, :m] = matrix.T
    equations[:6, m] = matrix.sum(0)
    equations[6, :m] = 1.0
    equations[6, m] = m
    objective = np.r_[np.zeros(m), -1.0]
    right = np.r_[np.zeros(6), 1.0]
    bounds = [(0, None)] * m + [(None, None)]
    strict = dict.fromkeys(TOLERANCES, 1e-10)
    solution = linprog(
        objective, A_eq=equations, b_eq=right, bounds=bounds, method="highs", options=strict
    )
    if solution.x is None:
        raise ArithmeticError("no coefficients balance")
    whole = np.zeros((7, m + 1), dtype=object)
    whole[:6, :m] = wrench.T
    whole[:6, m] = [sum(column) for column in wrench.T]
    whole[6, :m] = 1
    whole[6, m] = m
    last = np.array([0] * 6 + [1], dtype=object)
    largest = sorted(range(m), key=lambda k: -solution.x[k])[
        :NEAR_BASIS
    ]  # of equal ones, not every six are a basis
    columns = next(
        ([*six, m] for six in combinations(largest, 6) if _feasible(whole[:, [*six, m]], last)),
        None,
    )
    if columns is None:
        raise ArithmeticError("the basis is not feasible")
    while True:
        primal = solve(whole[:, columns], last)
        dual = solve(whole[:, columns].T, last)
        assert primal is not None and dual is not None
        entering = next(
            (k for k in range(m) if sum(y * a for y, a in zip(dual, whole[:, k], strict=True)) < 0),
            None,
        )
        if entering is None:
            return primal[6]
        change = solve(whole[:, columns], whole[:, entering])
        assert change is not None
        lengths = {i: primal[i] / change[i] for i in range(6) if change[i] > 0}
        columns[min(lengths, key=lambda i: (lengths[i], columns[i]))] = entering


def _feasible(basis: np.ndarray, right: np.ndarray) -> bool:
    """Tell whether a basis has a solution without negative coefficients; the margin, its last
    unknown, is free.
    """
    values = solve(basis, right)
    return values is not None and min(values[:-1]) >= 0


def solve(matrix: np.ndarray, right: np.ndarray) -> list[Fraction] | None:
    """Solve a system of integers exactly, by elimination without fractions (Bareiss); None where it
    is singular.
    """
    n = len(matrix)
    rows = [[*map(int, matrix[i]), int(right[i])] for i in range(n)]
    last = 1
    for k in range(n):
        at = next((i for i in range(k, n) if rows[i][k]), None)
        if at is None:
            return None
        rows[k], rows[at] = rows[at], rows[k]
        for i in range(n):
            if i != k:
                rows[i] = [
                    (rows[k][k] * x - rows[i][k] * y) // last
                    for x, y in zip(rows[i], rows[k], strict=True)
                ]
        last = rows[k][k]
    return [Fraction(rows[i][n], rows[i][i]) for i in range(n)]


def _integers(values: np.ndarray, power: int) -> np.ndarray:
    """Return the nearest multiples of 2^-power as Python integers."""
    return np.vectorize(round, otypes=[object])(values * 2.0**power)
