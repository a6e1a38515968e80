"""Certificates of frictional form closure, Eq. (13): a verdict for every triple, and the numbers that prove it.

A closed row has a balance, an open one a witness: a wrench that no contact opposes. Both are found together for all
rows at once (see `margin`), and a proof needs no trust in who found it: the balance bounds the margin from below, the
witness from above. Only where the two leave the verdict open, HiGHS decides.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.errors import BadArgument
from torchgrasp.frames import degenerate
from torchgrasp.plan.closure_lp import solve_closure_lp
from torchgrasp.plan.wrench import MIN_MARGIN, MIN_RANK_RATIO, rank_ratio, wrenches
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Certificate, Contacts

EXACT = 1e-13
"""Largest |W phi| of a balance that needs no solver: with full rank, phi less than 1e-9 away balances exactly."""

GAP = 1e-9
"""Largest difference of the two bounds of a proven margin, which must be as far from `MIN_MARGIN`."""

MAX_RESIDUAL = 1e-6
"""Largest |W phi| of a balance that HiGHS found, for wrenches of length about 1."""

STRICT = 1e-10
"""Tolerances of HiGHS, the least it takes. By its own, 1e-7, margins come out 1e-8 off, on the wrong side of 1e-6."""

UNIT_TOLERANCE = 1e-3
"""How far the length of a given normal may be from 1."""


def certify(contacts: Contacts, spec: ContactSpec | None = None) -> Certificate:
    """Prove that each triple has frictional form closure, Eq. (13), or that it has not, in float64.

    The margin is that of max s: W phi = 0, sum phi = 1, phi >= s, with `spec.edges` edges of each cone at
    `spec.planned_friction`. A row is closed with a margin of 1e-6 and full rank. Of a row that is not, every edge
    wrench has a product with the witness of at least 0 to rounding, or of at least minus the margin where that lies
    between 0 and 1e-6. Of a row that lacks only rank, the witness is the direction in which its wrenches are least. A
    row with a number that is not finite is not closed and holds NaN. The margin is -inf where no phi balances.

    Args:
        contacts: triples of any planner, outward unit normals; other fields are not read.
        spec: friction and edges; `ContactSpec()` by default.

    Raises:
        BadArgument: `contacts` of a wrong shape, or with normals that are not of length 1 (to 1e-3); no `ContactSpec`.

    >>> corners = torch.tensor([[[1.0, 0, 0], [-0.6, 0.8, 0], [-0.6, -0.8, 0]]])
    >>> certify(Contacts(corners, corners)).closed
    tensor([True])
    """
    spec = ContactSpec() if spec is None else spec
    if not isinstance(spec, ContactSpec):
        raise BadArgument("spec", type(spec).__name__, "a ContactSpec")
    points, normals = _checked(contacts)
    whole = torch.isfinite(points).flatten(1).all(-1) & torch.isfinite(normals).flatten(1).all(-1)
    margin, ratio, residual = (torch.full((len(points),), torch.nan, dtype=torch.float64) for _ in range(3))
    witness = torch.full((len(points), 6), torch.nan, dtype=torch.float64)
    points = points[whole]
    wrench = wrenches(points, normals[whole], spec.planned_friction, spec.edges)
    ratio[whole] = rank_ratio(wrench)
    spans = (ratio[whole] >= MIN_RANK_RATIO) & ~degenerate(points)
    margin[whole], residual[whole], witness[whole] = _prove(wrench.flatten(1, 2))
    balanced = (margin >= MIN_MARGIN) & (residual <= MAX_RESIDUAL)
    closed = balanced.clone()
    closed[whole] &= spans
    lacking = torch.nonzero(balanced & ~closed)[:, 0]
    if len(lacking):
        least = wrench[torch.nonzero(balanced[whole] & ~spans)[:, 0]].flatten(1, 2)
        witness[lacking] = torch.linalg.svd(least, full_matrices=False).Vh[:, -1]
    device = contacts.points.device
    return Certificate(*(t.to(device) for t in (margin, ratio, residual, closed, witness)))


def _prove(
    wrench: Float[Tensor, "b m 6"],
) -> tuple[Float[Tensor, "b"], Float[Tensor, "b"], Float[Tensor, "b 6"]]:
    """Return margin, residual and witness of each row, by HiGHS where those of the batch prove no verdict."""
    phi, witness = solve_closure_lp(wrench)
    residual = (phi[:, None] @ wrench)[:, 0].abs().amax(-1)
    margin, most = phi.amin(-1), bound_margin(wrench, witness)
    none = most < -1 / GAP
    margin, residual = torch.where(none, -torch.inf, margin), torch.where(none, torch.inf, residual)
    proven = (residual <= EXACT) & (most - margin <= GAP) & ((margin - MIN_MARGIN).abs() > 2 * GAP)
    for row in torch.nonzero(~(proven | none))[:, 0].tolist():
        margin[row], residual[row], found = solve_by_highs(wrench[row].numpy())
        witness[row] = witness[row] if found is None else torch.from_numpy(found)
    return margin, residual, witness


def bound_margin(wrench: Float[Tensor, "b m 6"], witness: Float[Tensor, "b 6"]) -> Float[Tensor, "b"]:
    """Return the upper bound of the margin that any wrench w proves, whoever found it; NaN for a w of no use.

    With g_k = w.w_k, phi_k = s + psi_k and psi >= 0: 0 = sum phi g >= s sum g + (1 - m s) min g, and therefore
    s <= -min g / sum(g - min g).
    """
    product = (wrench @ witness[..., None])[..., 0]
    least = product.amin(-1)
    return -least / (product - least[:, None]).sum(-1)


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


def solve_by_highs(wrench: np.ndarray) -> tuple[float, float, np.ndarray | None]:
    """Return the largest s of one wrench matrix (m, 6), the largest |W phi| of its solution, and a witness.

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
        options={"primal_feasibility_tolerance": STRICT, "dual_feasibility_tolerance": STRICT},
    )
    if found.x is None:
        return -np.inf, np.inf, None
    phi, dual = found.x[:m] + found.x[m], found.eqlin.marginals[:6]
    return float(found.x[m]), float(np.abs(phi @ wrench).max()), -dual / np.linalg.norm(dual)
