"""Certificates of frictional form closure, Eq. (13), by a solver of its own; only the wrenches are the planner's."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.errors import BadArgument
from torchgrasp.frames import degenerate
from torchgrasp.plan.wrench import MIN_MARGIN, MIN_RANK_RATIO, rank_ratio, wrenches
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Certificate, Contacts

MAX_RESIDUAL = 1e-6
"""Largest |W phi| of a balance, for wrenches of length about 1."""

UNIT_TOLERANCE = 1e-3
"""How far the length of a given normal may be from 1."""


def certify(contacts: Contacts, spec: ContactSpec | None = None) -> Certificate:
    """Prove frictional form closure of each triple, Eq. (13): by a linear programme and a rank test, in float64.

    The programme is max s: W phi = 0, sum phi = 1, phi >= s, with `spec.edges` edges of each cone at
    `spec.planned_friction`. A triple on a line, in a point or with a number that is not finite is not closed; then
    the margin is -inf where no phi balances, or NaN.

    Args:
        contacts: triples of any planner, outward unit normals; other fields are not read.
        spec: friction and edges; `ContactSpec()` by default.

    Raises:
        BadArgument: `contacts` of a wrong shape, or with normals that are not of length 1 (to 1e-3); no `ContactSpec`.

    >>> corners = torch.tensor([[[1.0, 0, 0], [-0.6, 0.8, 0], [-0.6, -0.8, 0]]])
    >>> certify(Contacts(corners, corners, torch.zeros(1, 3), torch.zeros(1, 3))).closed
    tensor([True])
    """
    spec = ContactSpec() if spec is None else spec
    if not isinstance(spec, ContactSpec):
        raise BadArgument("spec", type(spec).__name__, "a ContactSpec")
    points, normals = _checked(contacts)
    whole = torch.isfinite(points).flatten(1).all(-1) & torch.isfinite(normals).flatten(1).all(-1)
    margin, ratio, residual = (torch.full((len(points),), torch.nan, dtype=torch.float64) for _ in range(3))
    wrench = wrenches(points[whole], normals[whole], spec.planned_friction, spec.edges)
    ratio[whole] = rank_ratio(wrench)
    solved = [_margin(w) for w in wrench.flatten(1, 2).numpy()]
    margin[whole] = torch.tensor([s for s, _ in solved], dtype=torch.float64)
    residual[whole] = torch.tensor([r for _, r in solved], dtype=torch.float64)
    closed = (margin >= MIN_MARGIN) & (residual <= MAX_RESIDUAL) & (ratio >= MIN_RANK_RATIO) & ~degenerate(points)
    device = contacts.points.device
    return Certificate(margin.to(device), ratio.to(device), residual.to(device), closed.to(device))


def _checked(contacts: Contacts) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3 3"]]:
    """Return points and normals in float64 on the CPU; refuse shapes and lengths that are wrong."""
    if not isinstance(contacts, Contacts):
        raise BadArgument("contacts", type(contacts).__name__, "Contacts")
    for name, value in (("points", contacts.points), ("normals", contacts.normals)):
        if value.ndim != 3 or value.shape[1:] != (3, 3) or not value.is_floating_point():
            found = f"shape {tuple(value.shape)} of {value.dtype}"
            raise BadArgument(f"contacts.{name}", found, "floating numbers of shape b x 3 x 3")
    if len(contacts.points) != len(contacts.normals):
        found = f"{len(contacts.points)} and {len(contacts.normals)} rows"
        raise BadArgument("contacts.points and contacts.normals", found, "as many rows of each")
    points, normals = contacts.points.detach().double().cpu(), contacts.normals.detach().double().cpu()
    off = (torch.linalg.vector_norm(normals, dim=-1) - 1).abs() > UNIT_TOLERANCE  # False for NaN: those are not closed
    if bool(off.any()):
        row, contact = torch.nonzero(off)[0].tolist()
        length = float(torch.linalg.vector_norm(normals[row, contact]))
        raise BadArgument(
            "contacts.normals", f"length {length:.4g} at row {row}, contact {contact}", "unit vectors (to 1e-3)"
        )
    return points, normals


def _margin(wrench: np.ndarray) -> tuple[float, float]:
    """Return the largest s of one wrench matrix (m, 6) and the largest |W phi| of its solution.

    With phi = s + psi and psi >= 0 the programme has seven equations and no inequality.
    """
    from scipy.optimize import linprog

    m = len(wrench)
    equations = np.zeros((7, m + 1))
    equations[:6, :m], equations[:6, m] = wrench.T, wrench.sum(0)
    equations[6, :m], equations[6, m] = 1.0, m
    found = linprog(
        c=np.r_[np.zeros(m), -1.0],
        A_eq=equations,
        b_eq=np.r_[np.zeros(6), 1.0],
        bounds=[(0, None)] * m + [(None, None)],
        method="highs",
    )
    if found.x is None:
        return -np.inf, np.inf
    phi = found.x[:m] + found.x[m]
    return float(found.x[m]), float(np.abs(phi @ wrench).max())
