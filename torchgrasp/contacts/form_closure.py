"""Frictional form closure, Eq. (13) of the paper: its margin with linearised cones, and exact tests
with round cones.

**The margin.** W holds the m contact wrenches a_k, and a is their mean. The linear programme is:
maximise s with W phi = 0, sum phi = 1, phi >= s. With c_k = m (a - a_k) its dual is: maximise a.v
with c_k.v <= 1, in six unknowns v. Then s = 1/m - a.v. The point v = 0 is feasible, so the simplex
method needs no first phase. At the optimum six constraints are tight, and a = sum lambda_k c_k over
these six with lambda >= 0. Then

    phi_k = s + m lambda_k  balances with margin s;      w = v has  w . a_k >= -s  for all k.

phi proves that the margin is at least s, and the witness w proves that it is at most s. If s <= 0,
no contact can push against w.

**Round cones.** Three balanced forces are coplanar, so a test in the plane of three contacts
decides. Four or five contacts are decided by proofs. A positive balance of some cone edges proves
closure. A wrench that no force of a round cone opposes disproves closure. A linear programme over
some edges finds a balance, or a wrench that no edge opposes. In the second case the forces that
oppose the wrench most become further edges.
"""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.base import FINGERTIPS, at_once, flatnonzero, in_chunks
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.fused import is_fused
from torchgrasp.geometry.frames import FLAT, degenerate, subsets
from torchgrasp.geometry.linalg import dot, eye_like, matvec, norm, perpendicular, unit
from torchgrasp.shape.kernel import is_plain

Vectors = Float[Tensor, "b f 3"]  # points or normals of the contacts in every row
Wrenches = Float[Tensor, "b m 6"]  # force, then torque
Coefficients = Float[Tensor, "b m"]  # of the wrenches
Guess = Coefficients | None  # coefficients of the first wrenches of each cone
SEAM = 1e-9  # least length of a tangent, as a share of the triangle's: above rounding
LOOKS_ON_GPU = 16  # pivots on a GPU between two looks at whether any programme goes on
# largest |W phi| of balanced coefficients: above rounding in float64, far below any wrench (about
# 1)
BALANCED = 1e-9
# least positive coefficient: far above the certificate's errors, far below 1 / (f e)
MIN_MARGIN = 1e-6
# least singular value of the wrenches over the largest: contacts on a line have 0
MIN_RANK_RATIO = 1e-3
# most pivots of one grasp: six reach a vertex, and with 24 wrenches fewer than 30 more reach the
# optimum
PIVOTS = 100
OPTIMAL = 1e-12  # multipliers below this are zero: the objective grows no further
# added to the gain of the artificial rows, far above any multiplier: they leave first
ARTIFICIAL_GAIN = 1e3
# a bound approached more slowly than this, for each unit of the step, is parallel to it
BLOCKING = 1e-11
GRASPS_PER_CHUNK = 2048  # grasps at a time: their tableaux stay in the cache
PARALLEL = 1e-9  # planar wrenches (of length about 1) with a shorter cross product are parallel
FIRST_EDGES = 4  # edges of a cone in the first programme
ROUNDS = 12  # most programmes: more make hardly a verdict sharper


def count_contacts(points: Float[Tensor, "*b f 3"]) -> int:
    """Return the number f of contacts of each set; raise `BadArgument` unless it is 3 to 5."""
    f = points.shape[-2]
    if not FINGERTIPS[0] <= f <= FINGERTIPS[1]:
        raise BadArgument("points", f"{f} contacts a set", "3 to 5 contacts")
    return f


def centre_and_radius(points: Vectors) -> tuple[Float[Tensor, "b 1 3"], Float[Tensor, "b 1 1"]]:
    """Return the centroid of each contact set, and its root-mean-square radius about the centroid,
    in the unit of the points.

    `points` have the shape (b, f, 3). Where all points of a set coincide, the radius is 1.
    """
    centre = points.mean(-2, keepdim=True)
    arms = points - centre
    size = torch.linalg.vector_norm(arms, dim=(-2, -1), keepdim=True)
    none = size == 0
    if not is_plain(points):
        # the length of a zero vector has no second derivative
        size = torch.linalg.vector_norm(torch.where(none, 1.0, arms), dim=(-2, -1), keepdim=True)
    radius = size / math.sqrt(points.shape[-2])
    return centre, torch.where(none, 1.0, radius)


def scaled_arms(points: Vectors) -> Vectors:
    """Return the vectors (b, f, 3) from the centroid of each contact set to its points, scaled to a
    root-mean-square length of 1.

    They have no unit: they are divided by the set's root-mean-square radius.
    """
    centre, radius = centre_and_radius(points)
    return (points - centre) / radius


def tangents(points: Vectors, normals: Vectors) -> Vectors:
    """Return a unit tangent (b, f, 3) of the surface at each contact. The first edge of the
    linearised friction cone leans along it.

    `points` and outward unit `normals` have the shape (b, f, 3), for f contacts in each of b sets.
    With three contacts the tangent lies in the plane through them. With four or five, each contact
    has its own choice among the planes through any three contacts. The choice has the greatest
    product of the triangle's area and the sine of its angle to the tangent plane. So the tangent
    rotates with the object. Where no plane gives a tangent, it points towards another contact, if
    possible. Otherwise it is arbitrary, and friction cannot give closure.
    """
    corners = subsets(points.shape[1], 3, points.device)
    first, second, third = (points[:, corner] for corner in corners.unbind(1))
    plane = torch.linalg.cross(second - first, third - first)  # (b, k, 3)
    outward = normals[:, :, None]
    inside = torch.linalg.cross(plane[:, None], outward)  # (b, f, k, 3)
    length, best = norm(inside).max(-1, keepdim=True)
    inside = _take(inside, best)
    size = norm(plane).amax(-1)[:, None, None]
    smallest = normals.abs().argmin(-1)
    axis = eye_like(3, normals)[smallest]
    stand_in = torch.linalg.cross(axis, normals)
    if points.shape[1] > 3:
        away = perpendicular(points[:, None] - points[:, :, None], outward)
        far, farthest = norm(away).max(-1, keepdim=True)
        distinct = far**2 > SEAM * size
        stand_in = torch.where(distinct, _take(away, farthest), stand_in)
    seam = ~(length > SEAM * size) | (size == 0)
    return unit(torch.where(seam, stand_in, inside))


def _take(vectors: Float[Tensor, "b f k 3"], index: Int[Tensor, "b f 1"]) -> Vectors:
    """Return the vector with the given index among the k vectors at each contact."""
    at = index[..., None].expand(-1, -1, 1, 3)
    return vectors.gather(2, at)[:, :, 0]


def cone_edges(
    normals: Float[Tensor, "*b 3"], tangent: Float[Tensor, "*b 3"], friction: float, edges: int
) -> Float[Tensor, "*b e 3"]:
    """Return the e = `edges` edges of linearised friction cones: forces on the object whose inward
    normal component is 1.

    `normals` are outward unit normals of the object. The first edge leans along the unit vector
    `tangent`, and `friction` is the coefficient of friction. All vectors are in one frame. `*b`
    stands for any leading axes.
    """
    edge = torch.arange(edges, dtype=normals.dtype, device=normals.device)
    angle = edge[:, None] * (2 * math.pi / edges)
    other = torch.linalg.cross(normals, tangent)
    lean = angle.cos() * tangent[..., None, :] + angle.sin() * other[..., None, :]
    return friction * lean - normals[..., None, :]


def wrenches(
    points: Vectors, normals: Vectors, friction: float, edges: int = 8
) -> Float[Tensor, "b f e 6"]:
    """Return the wrench (force, then torque) of each of the e `edges` of all linearised friction
    cones.

    They are w in Eq. (13) of the paper. `points` and outward unit `normals` have the shape (b, f,
    3), and `friction` is the coefficient of friction. The edges have normal component 1 and no
    unit. The torque is about the contacts' centroid, and lengths are divided by the contacts'
    root-mean-square radius.
    """
    force = cone_edges(normals, tangents(points, normals), friction, edges)
    arm = scaled_arms(points)[:, :, None]
    return with_torque(force, arm.expand_as(force))


def with_torque(force: Float[Tensor, "*b 3"], arm: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 6"]:
    """Return the wrench (*b, 6) of each force: the force, then its torque, the cross product of
    `arm` and `force`.

    `arm` leads from the point about which the torque is to the contact.
    """
    return torch.cat([force, torch.linalg.cross(arm, force)], -1)


def rank_ratio(wrench: Float[Tensor, "b f e 6"]) -> Float[Tensor, "b"]:
    """Return the ratio (no unit) of the smallest to the largest singular value of each contact
    set's wrench matrix.

    The matrix (6 x f e) holds the wrenches of the e edges of f friction cones. A ratio near 0 means
    that the contacts resist loads in some direction badly, or not at all.
    """
    values = torch.linalg.svdvals(wrench.flatten(1, 2))
    return values[:, -1] / values[:, 0]


def solve_closure_lp(
    wrench: Wrenches,
) -> tuple[Coefficients, Float[Tensor, "b 6"]]:
    """Return the coefficients phi that balance the m wrenches of each contact set with the greatest
    margin, and a witness.

    `wrench` has the shape (b, m, 6), phi (b, m), and the witness (b, 6). The margin is the smallest
    coefficient. The witness, a unit wrench, proves that no margin is greater. If no coefficients
    balance the wrenches, the witness proves that instead, and phi has no meaning. Rounding or too
    few pivots may spoil both: check them.
    """
    return in_chunks(_solve, wrench, at_once(wrench, GRASPS_PER_CHUNK))  # pyright: ignore[reportReturnType]


def _solve(wrench: Wrenches) -> tuple[Coefficients, Float[Tensor, "b 6"]]:
    """Return the result of `solve_closure_lp`, from the dual programme in the six unknowns of a
    wrench.
    """
    b, m, _ = wrench.shape
    mean = wrench.mean(1)
    found, index, multiplier = maximise(mean, m * (mean[:, None] - wrench))
    margin = 1 / m - multiplier.sum(1, keepdim=True)
    phi = margin.expand(b, m).scatter_add(1, index, m * multiplier)
    # Equal coefficients balance the wrenches: every direction proves the greatest margin, 1 / m.
    level = (found == 0).all(1, keepdim=True)
    return phi, unit(torch.where(level, wrench[:, 0], found))


def maximise(
    objective: Float[Tensor, "b d"], bounds: Float[Tensor, "b m d"]
) -> tuple[Float[Tensor, "b d"], Int[Tensor, "b d"], Float[Tensor, "b d"]]:
    """Return the solutions of b linear programmes: maximise a.v with c_k.v <= 1 for m bounds c_k.

    `objective` holds a, and `bounds` the c_k, each of d numbers. Three results are returned. The
    first is the best v, or a direction in which a.v grows without bound. The others are the indices
    of the d bounds that are tight, and their multipliers. The simplex method runs for all
    programmes at once, until all are optimal. The point v = 0 is feasible, so there is no first
    phase.
    """
    b, _, d = bounds.shape
    tight, ray = _pivot(objective, bounds)
    # From the tight rows alone, so that the roundings of the pivots are gone.
    artificial = tight < 0
    index = tight.clamp(min=0)
    chosen = bounds.gather(1, index[:, :, None].expand(b, d, d))
    basis = torch.where(artificial[:, :, None], eye_like(d, bounds), chosen)
    vertex, _ = torch.linalg.solve_ex(basis, (~artificial).to(bounds))
    multiplier, _ = torch.linalg.solve_ex(basis.mT, objective)
    multiplier = torch.where(artificial, 0.0, multiplier)
    unbounded = (ray != 0).any(1, keepdim=True)
    return torch.where(unbounded, ray, vertex), index, multiplier


def _pivot(
    objective: Float[Tensor, "b d"], bounds: Float[Tensor, "b m d"]
) -> tuple[Int[Tensor, "b d"], Float[Tensor, "b d"]]:
    """Return the indices of the tight bounds of the programmes of `maximise`, then directions.

    The index is -1 for the rows of v = 0 itself that never left. The direction is that in which
    a.v grows without bound, or 0.
    """
    if is_fused(objective, bounds):
        from torchgrasp.contacts import fused_pivots  # it imports numba

        numbers = PIVOTS, OPTIMAL, ARTIFICIAL_GAIN, BLOCKING
        return fused_pivots.pivot(objective, bounds, numbers)
    b, m, d = bounds.shape
    row = torch.arange(b, device=bounds.device)
    # The first tight rows are artificial, v = 0 itself: they leave first, in either direction.
    tight = bounds.new_full((b, d), -1).long()
    inverse = eye_like(d, bounds).repeat(b, 1, 1)
    slack = bounds.new_ones(b, m)
    ray = bounds.new_zeros(b, d)
    running = torch.ones_like(row, dtype=torch.bool)
    every = 1 if bounds.device.type == "cpu" else LOOKS_ON_GPU
    for k in range(PIVOTS):
        multiplier = (objective[:, None] @ inverse)[:, 0]
        artificial = tight < 0
        # Leave along the edge on which the objective grows fastest; the multiplier of a bound may
        # not be negative.
        gain = torch.where(artificial, multiplier.abs(), -multiplier)
        rising = artificial & (gain > OPTIMAL)
        most, leaving = torch.where(rising, gain + ARTIFICIAL_GAIN, gain).max(1)
        running = running & (most > OPTIMAL)
        if k % every == 0 and not bool(running.any()):
            break
        backward = artificial & (multiplier > 0)
        sign = torch.where(backward, 1.0, -1.0).to(inverse)[row, leaving]
        edge = inverse[row, :, leaving]
        step = sign[:, None] * edge
        rate = matvec(bounds, step)
        blocking = rate > BLOCKING * norm(step, keepdim=True)
        # a tight bound blocks nothing
        index = tight.clamp(min=0)
        blocking.scatter_(1, index, blocking.gather(1, index) & artificial)
        length, entering = torch.where(blocking, slack / rate, torch.inf).min(1)
        unbounded = running & torch.isinf(length)
        ray = torch.where(unbounded[:, None], step, ray)
        running = running & ~unbounded
        length = torch.where(running, length.clamp(min=0.0), 0.0)
        slack = slack - length[:, None] * rate
        normal = bounds[row, entering]
        change = (normal[:, None] @ inverse)[:, 0]
        pivot = change[row, leaving]
        change[row, leaving] -= 1.0
        scaled = edge / pivot[:, None]
        updated = inverse - scaled[:, :, None] * change[:, None]
        inverse = torch.where(running[:, None, None], updated, inverse)
        before = tight[row, leaving]
        tight[row, leaving] = torch.where(running, entering, before)
    return tight, ray


def closed_exact(
    points: Vectors, normals: Vectors, friction: float, guess: Guess = None
) -> Bool[Tensor, "b"]:
    """Return a mask of the contact sets with frictional form closure under round cones; borderline
    sets are not closed.

    `points` and outward unit `normals` have the shape (b, f, 3), and `friction` is the coefficient
    of friction. `guess` holds the coefficients (b, m) that `first_balance` gives for similar
    contacts, which save time. None means no guess.
    """
    if points.shape[1] == 3:
        if is_fused(points, normals):
            from torchgrasp.contacts import fused_plane  # it imports numba

            return fused_plane.closed_in_plane(points, normals, friction, PARALLEL, FLAT)
        closed = _closed_in_plane(points, normals, friction)
    else:
        closed = _closed_by_proof(points, normals, friction, guess)
    rows = flatnonzero(closed)
    closed[rows] = ~degenerate(points[rows])
    return closed


def first_balance(points: Vectors, normals: Vectors, friction: float) -> Coefficients:
    """Return coefficients (b, m) that balance the wrenches of m = 4 f cone edges with the greatest
    margin.

    They are arbitrary if no coefficients balance them. `points` and outward unit `normals` have the
    shape (b, f, 3), and `friction` is the coefficient of friction.
    """
    return solve_closure_lp(_first_wrenches(points, normals, friction))[0]


def _first_wrenches(points: Vectors, normals: Vectors, friction: float) -> Wrenches:
    """Return the wrenches of the m = 4 f edges of friction cones with four edges."""
    return wrenches(points, normals, friction, FIRST_EDGES).flatten(1, 2)


def _closed_in_plane(points: Vectors, normals: Vectors, friction: float) -> Bool[Tensor, "b"]:
    """Return a mask of the sets of three contacts that have force closure. Balanced forces lie in
    the plane of the contacts.

    Each friction cone cuts an angle from the plane. The six planar wrenches along the sides of
    these angles must positively span all planar wrenches. So no plane through two of the wrenches
    has the others on one side.
    """
    arm = scaled_arms(points)
    first, second, third = arm.unbind(1)
    across = unit(torch.linalg.cross(second - first, third - first))
    along = unit(second - first)
    basis = torch.stack([along, torch.linalg.cross(across, along)], -1)  # (b, 3, 2)
    inward = -normals @ basis
    position = arm @ basis
    projected = norm(inward)
    cone = math.cos(math.atan(friction))
    # the others have a cone that the plane does not cut
    rows = flatnonzero((projected > cone).all(-1))
    half = torch.arccos(cone / projected[rows])
    closed = points.new_zeros(len(points), dtype=torch.bool)
    closed[rows] = _spans_plane(inward[rows], position[rows], half)
    return closed


def _spans_plane(
    inward: Float[Tensor, "b 3 2"], position: Float[Tensor, "b 3 2"], half: Float[Tensor, "b 3"]
) -> Bool[Tensor, "b"]:
    """Return a mask of the sets of three planar cones that positively span all planar wrenches.

    A cone has its apex at a `position`, and its axis along `inward`. The angle between axis and
    sides is `half` [rad].
    """
    middle = torch.atan2(inward[..., 1], inward[..., 0])
    angle = torch.stack([middle - half, middle + half], -1)  # (b, 3, 2)
    cosine = angle.cos()
    sine = angle.sin()
    x, y = position[..., None].unbind(-2)
    planar = torch.stack([cosine, sine, x * sine - y * cosine], -1)
    planar = planar.flatten(1, 2)  # (b, 6, 3): forces in the plane and their torque
    first, second = subsets(6, 2, inward.device).unbind(-1)
    plane = torch.linalg.cross(planar[:, first], planar[:, second])  # (b, 15, 3)
    side = plane @ planar.mT  # (b, 15, 6)
    spans = norm(plane) > PARALLEL
    both = (side.amax(-1) > PARALLEL) & (side.amin(-1) < -PARALLEL)
    return (both | ~spans).all(-1) & spans.any(-1)


def _closed_by_proof(
    points: Vectors, normals: Vectors, friction: float, guess: Guess
) -> Bool[Tensor, "b"]:
    """Return a mask of the sets of four or five contacts that have force closure.

    Cones get edges until each verdict is proven.
    """
    closed = points.new_zeros(len(points), dtype=torch.bool)
    if friction == 0:  # forces along normals may balance, but only seven or more span all wrenches
        return closed
    finite = torch.isfinite(points) & torch.isfinite(normals)
    rows = flatnonzero(finite.flatten(1).all(1))
    wrench = _first_wrenches(points[rows], normals[rows], friction)
    if guess is not None:
        phi = guess[rows]  # corrected to balance the wrenches
        weighted = phi.square()[..., None] * wrench
        factor, _ = torch.linalg.cholesky_ex(wrench.mT @ weighted)
        dual = torch.cholesky_solve((phi[:, None] @ wrench).mT, factor)
        proven = _balances(wrench, phi - (weighted @ dual)[..., 0])
        closed[rows[proven]] = True
        rows = rows[~proven]
        wrench = wrench[~proven]
    for _ in range(ROUNDS):
        phi, witness = solve_closure_lp(wrench)
        proven = _balances(wrench, phi)
        closed[rows[proven]] = True
        least, opposing = most_opposing(points[rows], normals[rows], friction, witness)
        left = flatnonzero(~proven & (least.amin(-1) < -BALANCED))
        if len(left) == 0:
            break
        rows = rows[left]
        wrench = torch.cat([wrench[left], opposing[left]], 1)
    return closed


def _balances(wrench: Wrenches, phi: Coefficients) -> Bool[Tensor, "b"]:
    """Return for each contact set whether the coefficients `phi` are positive and sum its wrenches
    to zero.
    """
    return (residual_of(wrench, phi) <= BALANCED) & (phi.amin(-1) > BALANCED)


def residual_of(wrench: Wrenches, phi: Coefficients) -> Float[Tensor, "b"]:
    """Return the largest absolute number in the sum of m wrenches, each multiplied by its
    coefficient.

    `wrench` (b, m, 6) holds the wrenches of b contact sets, and `phi` (b, m) their coefficients;
    both have no unit.
    """
    return (phi[:, None] @ wrench)[:, 0].abs().amax(-1)


def most_opposing(
    points: Vectors, normals: Vectors, friction: float, witness: Float[Tensor, "b 6"]
) -> tuple[Float[Tensor, "b f"], Float[Tensor, "b f 6"]]:
    """Return the least product of the witness with a wrench in each contact's round friction cone,
    and that wrench.

    A witness is a wrench that disproves force closure: its products with all contact wrenches are
    at least 0. The wrenches have normal force 1, and lengths are divided by the contacts'
    root-mean-square radius. `points` and outward unit `normals` have the shape (b, f, 3), and
    `friction` is the coefficient of friction. A negative product refutes the witness.
    """
    arm = scaled_arms(points)
    force, torque = witness[:, None].expand(*points.shape[:2], 6).split(3, -1)
    motion = force + torch.linalg.cross(torque, arm)
    along = dot(motion, normals, keepdim=True)
    sideways = motion - along * normals
    length = norm(sideways, keepdim=True)
    push = -normals - friction * sideways / torch.where(length == 0, 1.0, length)
    least = -(along + friction * length)[..., 0]
    return least, with_torque(push, arm)
