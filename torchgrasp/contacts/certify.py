"""Certificates of frictional form closure, Eq. (13) of the paper: for each contact set a verdict,
with a proof.

Positive coefficients phi that balance all contact wrenches prove closure, and bound its margin from
below. A witness, which is a wrench that no contact opposes, disproves closure, and bounds the
margin from above. A batched simplex method (`form_closure`) finds both. The solver HiGHS decides
where the two bounds leave the verdict open.

The multipliers y of W phi = 0 are a multiple of the witness. By the envelope theorem a change dW of
the wrenches changes the margin by -y . (dW phi).
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.contacts.form_closure import (
    MIN_MARGIN,
    MIN_RANK_RATIO,
    Vectors,
    Wrenches,
    rank_ratio,
    residual_of,
    solve_closure_lp,
    wrenches,
)
from torchgrasp.foundation.base import FINGERTIPS, flatnonzero, map_rows
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import optimize
from torchgrasp.foundation.rules import is_known
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.geometry.frames import degenerate
from torchgrasp.geometry.linalg import UNIT_TOLERANCE, dot, matvec, norm
from torchgrasp.values.planning import Certificate, Contacts
from torchgrasp.values.specs import ContactSpec

EXACT = 1e-13  # largest |W phi| of a balance that needs no solver: an exact balance is near
# largest difference of the two bounds of a proven margin, which must lie twice as far from
# `MIN_MARGIN`
GAP = 1e-9
MAX_RESIDUAL = 1e-6  # largest |W phi| of a balance found by HiGHS, for wrenches of length about 1
# tolerance of HiGHS, its least. With its default, 1e-7, margins err by 1e-8 and may cross
# `MIN_MARGIN`.
STRICT = 1e-10


@checked(gradients=True)
@single_threaded
def certify(contacts: Contacts, spec: ContactSpec | None = None) -> Certificate:
    """Return whether each of b contact sets has frictional form closure (Eq. 13 of the paper), with
    a proof in float64.

    The answer is `Certificate.closed`. Frictional form closure is also called force closure. The
    contacts then resist any load if the fingers press hard enough.

    The wrenches w of a set are forces along the edges of its friction cones, with their torques.
    They are the columns of W. Coefficients phi with W phi = 0 and sum phi = 1 balance them. The
    margin is the largest s with phi >= s for such a phi, or -inf without one. A set is `closed` if
    its margin is at least 1e-6 (`MIN_MARGIN`) and its `rank_ratio` at least 1e-3
    (`MIN_RANK_RATIO`). In addition, its contacts must not lie almost on a line, and phi must
    balance W up to rounding.

    If a set is not closed, its `witness` is a unit wrench v that no contact force opposes. It is in
    the frame of the contacts and scaled as w (`Certificate`). For every edge wrench w then v . w >=
    0, up to rounding. If the margin suffices, but the set is not closed, the wrenches are smallest
    along v. A set with a contact that is not finite is not closed. Its margin and witness are NaN.

    The margin has a first derivative with respect to points and normals:

    * At a kink, where several derivatives are possible, it is one of them.
    * Where the margin is greatest (all phi are equal), it is 0.
    * Where the margin is -inf, it is NaN. Such a set adds nothing to the gradient of a loss that
      masks its margin.

    In forward mode the derivatives of other fields are NaN.

    Args:
        contacts: sets of three to five contacts (b, f, 3) [m] with outward unit normals, from any
            planner.
        spec: its `edges` and `planned_friction` define the friction cones; None means
            `ContactSpec()`.

    Raises `BadArgument` for:

    * contacts of a wrong shape, or sets that do not have three to five contacts;
    * normals that are not of length 1 (to 1e-3);
    * a second derivative, or a backward derivative of another field than the margin.

    >>> corners = torch.tensor([[[1.0, 0, 0], [-0.6, 0.8, 0], [-0.6, -0.8, 0]]])
    >>> certify(Contacts(corners, corners)).closed
    tensor([True])
    """
    spec = ContactSpec() if spec is None else spec
    points = check_contacts(contacts).points.double()
    normals = check_unit(contacts.normals.double())
    wrench = wrenches(points, normals, spec.planned_friction, spec.edges)
    return Certificate(*_Proof.apply(wrench.flatten(1, 2), degenerate(points))[:5])


class _Proof(torch.autograd.Function):
    """The proof of force closure as a differentiable function of m wrenches.

    Its results are the first five fields of a `Certificate`, and the coefficients phi (b, m). Last
    are the multipliers (b, 6) of W phi = 0.
    """

    @staticmethod
    def forward(wrench: Wrenches, flat: Bool[Tensor, "b"]) -> tuple[Tensor, ...]:
        """Return the fields of the certificate, phi and the multipliers of contact sets with m
        wrenches each.

        They are NaN for a `wrench` that is not finite. `flat` marks sets whose contacts lie on a
        line or in a point.
        """
        b, m, _ = wrench.shape
        margin, ratio, residual = (wrench.new_full((b,), torch.nan) for _ in range(3))
        witness, phi, dual = (wrench.new_full((b, width), torch.nan) for width in (6, m, 6))
        rows = flatnonzero(torch.isfinite(wrench).flatten(1).all(-1))
        known = wrench[rows]
        ratio[rows] = rank_ratio(known[:, None])
        margin[rows], residual[rows], witness[rows], phi[rows], dual[rows] = _prove(known)
        balanced = (margin >= MIN_MARGIN) & (residual <= MAX_RESIDUAL)
        closed = balanced & (ratio >= MIN_RANK_RATIO) & ~flat
        lacking = flatnonzero(balanced & ~closed)
        if len(lacking):
            witness[lacking] = torch.linalg.svd(wrench[lacking], full_matrices=False).Vh[:, -1]
        return margin, ratio, residual, closed, witness, phi, dual

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        """Store the wrenches, phi and the multipliers, which the derivatives need."""
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(output[3], *output[5:])
        ctx.save_for_backward(inputs[0], *output[5:])
        ctx.save_for_forward(inputs[0], *output[5:])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, None]:
        """Return the derivative by the wrenches; raise `BadArgument` unless it is that of the
        margin alone.
        """
        margin = grads[0]
        wrench, phi, dual = ctx.saved_tensors
        if any(x is not None for x in grads[1:]):
            raise BadArgument(
                "contacts", "a derivative of another field of the certificate", "one of its margin"
            )
        if margin is None:
            return None, None
        # a row that is masked adds nothing, even where its derivative is NaN
        dual = torch.where(margin[:, None] == 0, 0.0, dual)
        phi = torch.where(margin[:, None] == 0, 0.0, phi)
        derivative = -margin[:, None, None] * phi[..., None] * dual[:, None]
        return _Once.apply(derivative, wrench), None

    @staticmethod
    def jvp(ctx: Any, *grad_inputs: Any) -> tuple[Tensor | None, ...]:
        """Return the change of each result for a change of the wrenches; only that of the margin is
        not NaN.
        """
        wrench, phi, dual = ctx.saved_tensors
        balance = (phi[:, None] @ grad_inputs[0])[:, 0]  # (b, 6)
        change = _Once.apply(-dot(balance, dual), wrench)
        unknown = torch.full_like(change, torch.nan)
        witness = unknown[:, None].repeat(1, 6)
        return change, unknown, unknown, None, witness, None, None

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, ...], *args: Tensor
    ) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        """Prove together the contact sets of all entries of the mapped axis."""
        return map_rows(_Proof.apply, info.batch_size, in_dims, args)


class _Once(torch.autograd.Function):
    """The first derivative of the margin with respect to the `wrench`; a second derivative is an
    error.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(derivative: Tensor, wrench: Tensor) -> Tensor:
        """Return a copy of the derivative."""
        return derivative.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        """Store nothing."""

    @staticmethod
    def backward(ctx: Any, *_: Any) -> Any:
        """Raise `BadArgument`: the margin has no second derivative."""
        raise BadArgument(
            "contacts",
            "a second derivative of the margin",
            "a first derivative: the rest is not smooth",
        )

    jvp = backward


def _prove(wrench: Wrenches) -> tuple[Tensor, ...]:
    """Return margin (b,), residual |W phi| (b,), witness (b, 6), phi (b, m) and multipliers (b, 6)
    for m wrenches of each set.
    """
    phi, witness = solve_closure_lp(wrench)
    residual = residual_of(wrench, phi)
    margin = phi.amin(-1)
    upper = bound_margin(wrench, witness)
    unbalanced = upper < -1 / GAP
    margin = torch.where(unbalanced, -torch.inf, margin)
    residual = torch.where(unbalanced, torch.inf, residual)
    proven = (residual <= EXACT) & (upper - margin <= GAP)
    proven &= (margin - MIN_MARGIN).abs() > 2 * GAP
    for row in flatnonzero(~(proven | unbalanced)).tolist():
        margin[row], residual[row], found, balance = solve_by_highs(wrench[row].cpu().numpy())
        phi[row] = balance.to(phi)
        if found is not None:
            witness[row] = torch.from_numpy(found).to(witness)
    product = matvec(wrench, witness)
    above = product - product.amin(-1, keepdim=True)
    dual = witness / above.sum(-1, keepdim=True)
    # The greatest possible margin is a peak, where 0 is one of the derivatives.
    peak = wrench.shape[1] * margin >= 1 - GAP
    dual = torch.where(peak[:, None], 0.0, dual)
    dual = torch.where(margin.isinf()[:, None], torch.nan, dual)
    return margin, residual, witness, phi, dual


def bound_margin(wrench: Wrenches, witness: Float[Tensor, "b 6"]) -> Float[Tensor, "b"]:
    """Return the upper bound of the closure margin that each direction `witness` in wrench space
    proves.

    `wrench` (b, m, 6) holds the m edge wrenches of each contact set. Let g be their products with
    the witness. The bound is -min(g) / sum(g - min(g)), or NaN if all g are 0. The margin is the
    greatest s for which coefficients >= s, of sum 1, balance these wrenches. The bound has no unit.
    """
    # With g_k = w.w_k and phi >= s, 0 = sum phi g >= s sum g + (1 - m s) min g. Hence s <= -min g /
    # sum(g - min g).
    product = matvec(wrench, witness)
    least = product.amin(-1)
    return -least / (product - least[:, None]).sum(-1)


def solve_by_highs(wrench: np.ndarray) -> tuple[float, float, np.ndarray | None, Tensor]:
    """Return closure margin, residual max |W phi|, witness (6,) and coefficients phi (m,) of one
    contact set, by HiGHS.

    `wrench` (m, 6) holds the m edge wrenches, which are the columns of W; nothing has a unit. Of
    all phi with W phi = 0 and sum 1, HiGHS finds one whose least coefficient is greatest. The
    margin is this coefficient. If no phi balances the wrenches, the margin is -inf, the residual
    inf, and phi 0. The witness is a wrench of length 1, which proves that no margin is greater. It
    is None if HiGHS gives none.
    """
    m = len(wrench)  # seven equations in the margin s and psi = phi - s >= 0
    equations = np.zeros((7, m + 1))
    equations[:6, :m] = wrench.T
    equations[:6, m] = wrench.sum(0)
    equations[6, :m] = 1.0
    equations[6, m] = m
    solution = optimize.linprog(
        c=np.r_[np.zeros(m), -1.0],
        A_eq=equations,
        b_eq=np.r_[np.zeros(6), 1.0],
        bounds=[(0, None)] * m + [(None, None)],
        method="highs",
        options={"primal_feasibility_tolerance": STRICT, "dual_feasibility_tolerance": STRICT},
    )
    if solution.x is None:
        return -np.inf, np.inf, None, torch.zeros(m, device="cpu")
    phi = solution.x[:m] + solution.x[m]
    dual = solution.eqlin.marginals[:6]
    length = np.linalg.norm(dual)
    # without multipliers the balance of wrenches costs no margin
    witness = -dual / length if length > 0 else None
    residual = float(np.abs(phi @ wrench).max())
    return float(solution.x[m]), residual, witness, torch.from_numpy(phi)


def check_unit(normals: Vectors) -> Vectors:
    """Return the normals (b, f, 3); raise `BadArgument` if the length of a normal is not 1 to 1e-3.

    Normals with NaN are accepted.
    """
    if not is_known(normals):
        return normals
    length = norm(normals.detach())
    wrong = torch.nonzero((length - 1).abs() > UNIT_TOLERANCE)
    if len(wrong):
        row, contact = wrong[0].tolist()
        found = f"length {float(length[row, contact]):.4g} at row {row}, contact {contact}"
        raise BadArgument("contacts.normals", found, "unit vectors (to 1e-3)")
    return normals


def check_contacts(contacts: Contacts) -> Contacts:
    """Return the contacts; raise `BadArgument` for wrong shapes, or sets that do not have 3 to 5
    contacts.
    """
    points = contacts.points
    for name, value in (("points", points), ("normals", contacts.normals)):
        if value.shape != (*points.shape[:2], 3) or not value.is_floating_point():
            found = f"shape {tuple(value.shape)} of {value.dtype}"
            raise BadArgument(
                f"contacts.{name}", found, "floating numbers of shape b x f x 3, as many of each"
            )
    if not FINGERTIPS[0] <= points.shape[1] <= FINGERTIPS[1]:
        allowed = f"{FINGERTIPS[0]} to {FINGERTIPS[1]}, one for each fingertip"
        raise BadArgument("contacts.points", f"{points.shape[1]} contacts a row", allowed)
    return contacts
