"""The search of `torchgrasp.contacts.critical` for the least friction as one compiled loop over
contact sets.

The functions are named as the methods there, and compute the same for one contact set. Here motion
and friction are one array of unknowns, in the order of the eight equations.
"""

import collections
import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.contacts.form_closure import Vectors, scaled_arms
from torchgrasp.foundation.fused import array, compiled, inlined
from torchgrasp.geometry.fused_vectors import add, cross, dot, put, scale

NUMBERS = (
    "most exact steps first above pushing within power short stuck raised off polishing rounding"
)
SearchNumbers = collections.namedtuple("SearchNumbers", NUMBERS.split())
"""Numbers of `CriticalNumbers` of the same names."""
ConeArrays = collections.namedtuple("ConeArrays", "rows constants")
"""`rows` (f, 8, 3) and `constants` (8) of `_Cones`. The last row is that of the friction."""
BalanceArrays = collections.namedtuple("BalanceArrays", "forces multipliers unknowns")
"""`forces` and `multipliers` (f, 3) of `_Balance`, and its `unknowns` (8)."""
ScalingArrays = collections.namedtuple("ScalingArrays", "cones form stiff beta soft system")
"""`cones` (2, f, 3) and `form` (2, f) of `_Scaling`, and the numbers of `_Cones.directions`.

They are `stiff` (f, 3), `beta` (f), `soft` (f, 10, 3): the softened rows and two free forces, and
`system` (8, 10): the upper half of the matrix and two right sides.
"""
ChangeArrays = collections.namedtuple("ChangeArrays", "forces cones unknowns")
"""`forces` (2, f, 3) and `cones` (2, 2, f, 3) of `_Change`, and that of the `unknowns` (2, 8).

Newton's step to nu = 0 comes first, then its change for each unit of nu.
"""


@inlined
def _stretched(mu, v):
    """Return M v."""
    return mu * v[0], v[1], v[2]


@inlined
def _flipped(v):
    """Return J v."""
    return v[0], -v[1], -v[2]


@inlined
def _solve(system):
    """Replace the right sides of symmetric equations by the solutions.

    The rows of `system` hold the upper half of the matrix, then the right sides.
    """
    d, width = system.shape
    for k in range(d):
        inverse = 1.0 / system[k, k]
        for r in range(k + 1, d):
            factor = system[k, r] * inverse
            for q in range(r, width):
                system[r, q] -= factor * system[k, q]
    for r in range(d - 1, -1, -1):
        inverse = 1.0 / system[r, r]
        for q in range(d, width):
            for k in range(r + 1, d):
                system[r, q] -= system[r, k] * system[k, q]
            system[r, q] *= inverse


@inlined
def _of_contacts(axes, arms, load, cones):
    """Write the rows and constants, as `_Cones.of`."""
    f = len(arms)
    for i in range(f):
        for c in range(3):
            torque = cross(arms[i], axes[i, c])
            for r in range(3):
                cones.rows[i, r, c] = axes[i, c, r]
                cones.rows[i, 3 + r, c] = torque[r]
        put(cones.rows[i, 6], (-1.0, 0.0, 0.0))
    for r in range(6):
        cones.constants[r] = load[r]
    cones.constants[6] = f
    cones.constants[7] = 1.0


@inlined
def _first(n, cones, at, gram):
    """Write the start, as `_Cones.first`."""
    f = len(at.forces)
    for r in range(6):
        gram[r, 6] = cones.constants[r]
        for q in range(r, 6):
            gram[r, q] = 0.0
        for i in range(f):
            gram[r, 6] += cones.rows[i, r, 0]
            for q in range(r, 6):
                gram[r, q] += dot(cones.rows[i, r], cones.rows[i, q])
    _solve(gram)
    pushes = True
    for i in range(f):
        balanced = (1.0, 0.0, 0.0)
        for r in range(6):
            balanced = add(balanced, cones.rows[i, r], -gram[r, 6])
        put(at.forces[i], balanced)
        pushes = pushes and balanced[0] > n.pushing
    total = 0.0
    for i in range(f):
        if not pushes:
            put(at.forces[i], (1.0, 0.0, 0.0))
        total += at.forces[i, 0]
    ratio = 0.0
    for i in range(f):
        push, one, two = scale(at.forces[i], f / total)
        put(at.forces[i], (push, one, two))
        ratio = max(ratio, math.sqrt(one * one + two * two) / push)
    friction = n.first * ratio + n.above
    work = 0.0
    for i in range(f):
        x = _stretched(friction, at.forces[i])
        put(at.multipliers[i], scale(_flipped(x), 1.0 / dot(x, _flipped(x))))
        work += at.forces[i, 0] * at.multipliers[i, 0]
    for i in range(f):
        put(at.multipliers[i], scale(at.multipliers[i], 1.0 / work))
    for r in range(6):
        at.unknowns[r] = 0.0
    at.unknowns[6] = -2.0 / work
    at.unknowns[7] = friction


@inlined
def _scale(at, scaling):
    """Write the points of a balance, as `_Scaling.of`, and return the mean nu."""
    product = 0.0
    for i in range(len(at.forces)):
        x = _stretched(at.unknowns[7], at.forces[i])
        s = at.multipliers[i]
        put(scaling.cones[0, i], x)
        put(scaling.cones[1, i], s)
        scaling.form[0, i] = dot(x, _flipped(x))
        scaling.form[1, i] = dot(s, _flipped(s))
        product += dot(x, s)
    return product / (2.0 * len(at.forces))


@inlined
def _softened(soft, beta, mu, z):
    """Return the product of a vector with M^-1 D^-1 M^-1."""
    plain = beta / (mu * mu) * z[0], -beta * z[1], -beta * z[2]
    return add(scale(soft, dot(z, soft)), plain, -1.0)


@inlined
def _write_equations(held, cones, at, scaling):
    """Write the equations of the unknowns, as the first half of `_Cones.directions`."""
    mu = at.unknowns[7]
    system = scaling.system
    bent = 0.0
    pressing = 0.0
    for i in range(len(at.forces)):
        push = at.forces[i, 0]
        rows = cones.rows[i]
        x = scaling.cones[0, i]
        s = scaling.cones[1, i]
        size_x = math.sqrt(scaling.form[0, i])
        size_s = math.sqrt(scaling.form[1, i])
        beta = size_x / size_s
        gain = 1.0 + dot(x, s) / (size_x * size_s)
        point = add(scale(x, 1.0 / size_x), _flipped(s), 1.0 / size_s)
        stiff = scale(_flipped(point), 1.0 / math.sqrt(beta * gain))
        soft = _stretched(1.0 / mu, scale(point, math.sqrt(beta / gain)))
        put(scaling.stiff[i], stiff)
        scaling.beta[i] = beta
        first, one, two = scale(_stretched(mu, stiff), push * stiff[0])
        loose = 0.0 if held else 1.0
        put(rows[7], scale((first - s[0] - x[0] / beta, one, two), loose))
        # what the forces would be if the eight unknowns did not change, and for each unit of nu
        lacking = _stretched(mu, s)
        for r in range(7):
            lacking = add(lacking, rows[r], -at.unknowns[r])
        pressed = _stretched(1.0 / mu, scale(_flipped(s), 1.0 / scaling.form[1, i]))
        put(scaling.soft[i, 8], _softened(soft, beta, mu, lacking))
        put(scaling.soft[i, 9], pressed)
        for r in range(8):
            put(scaling.soft[i, r], _softened(soft, beta, mu, rows[r]))
        bent += push * push * (stiff[0] * stiff[0] - 1.0 / beta)
        pressing += push * x[0] / scaling.form[0, i]
    for r in range(8):
        for q in range(r, 10):
            total = 0.0
            for i in range(len(at.forces)):
                total += dot(cones.rows[i, r], scaling.soft[i, q])
            system[r, q] = total
        system[r, 8] += cones.constants[r]
    system[7, 7] -= bent
    system[7, 9] -= pressing
    if held:
        system[7, 8] = 0.0
        system[7, 9] = 0.0


@inlined
def _directions(held, cones, at, scaling, changes):
    """Write both directions, as `_Cones.directions`."""
    _write_equations(held, cones, at, scaling)
    _solve(scaling.system)
    for h in range(2):
        for r in range(8):
            changes.unknowns[h, r] = scaling.system[r, 8 + h]
        for i in range(len(at.forces)):
            forces = scale(scaling.soft[i, 8 + h], 1.0)
            for r in range(8):
                forces = add(forces, scaling.soft[i, r], -changes.unknowns[h, r])
            if h == 0:
                forces = add(forces, at.forces[i], -1.0)
                constant = scale(at.multipliers[i], -1.0)
            else:
                constant = scale(_flipped(scaling.cones[0, i]), 1.0 / scaling.form[0, i])
            # the change of s follows from that of x
            first, one, two = _stretched(at.unknowns[7], forces)
            of_x = first + at.forces[i, 0] * changes.unknowns[h, 7], one, two
            of_s = add(constant, _flipped(of_x), 1.0 / scaling.beta[i])
            of_s = add(of_s, scaling.stiff[i], -dot(scaling.stiff[i], of_x))
            put(changes.forces[h, i], forces)
            put(changes.cones[h, 0, i], of_x)
            put(changes.cones[h, 1, i], of_s)


@inlined
def _plus(changes, share):
    """Add a share of the second direction to the first, as `_Change.plus`."""
    for i in range(changes.forces.shape[1]):
        put(changes.forces[0, i], add(changes.forces[0, i], changes.forces[1, i], share))
        for c in range(2):
            of_cone = add(changes.cones[0, c, i], changes.cones[1, c, i], share)
            put(changes.cones[0, c, i], of_cone)
    for r in range(8):
        changes.unknowns[0, r] += share * changes.unknowns[1, r]


@inlined
def _longest(scaling, changes):
    """Return the largest share of the first change, as `_Scaling.longest`."""
    nearest = 0.0
    for c in range(2):
        for i in range(changes.forces.shape[1]):
            form = scaling.form[c, i]
            change = changes.cones[0, c, i]
            along = dot(_flipped(scaling.cones[c, i]), change)
            bend = dot(_flipped(change), change)
            root = math.sqrt(max(along * along - form * bend, 0.0))
            nearest = max(nearest, (root - along) / form)
    return 1.0 / nearest if nearest > 0.0 else math.inf


@inlined
def _inside(at, changes, share):
    """Return whether the forces stay in the cones after a share of the first change, as
    `_Balance.inside`.
    """
    friction = at.unknowns[7] + share * changes.unknowns[0, 7]
    good = friction > 0.0
    for i in range(len(at.forces)):
        push, one, two = add(at.forces[i], changes.forces[0, i], share)
        good = good and push > 0.0 and (friction * push) ** 2 > one * one + two * two
    return good


@inlined
def _after(at, changes, share):
    """Go a share of the first change, as `_Balance.after`."""
    for i in range(len(at.forces)):
        put(at.forces[i], add(at.forces[i], changes.forces[0, i], share))
        put(at.multipliers[i], add(at.multipliers[i], changes.cones[0, 1, i], share))
    for r in range(8):
        at.unknowns[r] += share * changes.unknowns[0, r]


@inlined
def _balances(n, cones, at):
    """Return whether the forces balance, and the friction is not too large."""
    square = 0.0
    for r in range(6):
        total = cones.constants[r]
        for i in range(len(at.forces)):
            total += dot(cones.rows[i, r], at.forces[i])
        square += total * total
    return math.sqrt(square) <= n.rounding and at.unknowns[7] <= n.most


@inlined
def _nearer(n, at, scaling, changes):
    """Take a whole step to the last nu, unless it leaves a cone, as `_Cones.nearer`."""
    _plus(changes, n.exact)
    if _inside(at, changes, 1.0) and _longest(scaling, changes) > 1.0:
        _after(at, changes, 1.0)


@inlined
def _balance(n, shorter, cones, at, scaling, changes):
    """Go on to the last nu, and then polish; return whether the forces balance."""
    last = 1.0
    settled = False
    left = n.steps
    while left > 0:
        left -= 1
        held = last < n.short
        mean = _scale(at, scaling)
        _directions(held, cones, at, scaling, changes)
        if settled:
            _nearer(n, at, scaling, changes)
            continue
        undone = min(max(1.0 - _longest(scaling, changes), 0.0), 1.0)
        kept = 1.0 if held else undone**n.power
        target = max(kept * mean, n.exact)
        _plus(changes, target)
        longest = min(n.within * _longest(scaling, changes), 1.0)
        share = longest * shorter[0]
        for part in shorter:
            if _inside(at, changes, longest * part):
                share = longest * part
                break
        _after(at, changes, share)
        if held and share < n.stuck:
            at.unknowns[7] *= n.raised
        last = share
        work = 0.0
        for i in range(len(at.forces)):
            work += at.forces[i, 0] * at.multipliers[i, 0]
        if share == 1.0 and target == n.exact and abs(work - 1.0) <= n.off:
            if not _balances(n, cones, at):
                return False
            settled = True
            left = n.polishing
        elif not at.unknowns[7] < 2.0 * n.most:
            return False
    return settled


@inlined
def _along(at, axes, forces, press, slide):
    """Write forces and multipliers for the axes of the contacts, as `_Balance.along`."""
    for i in range(len(axes)):
        press[i], one, two = at.multipliers[i]
        for d in range(3):
            forces[i, d] = dot(at.forces[i], axes[i, :, d])
            slide[i, d] = one * axes[i, 1, d] + two * axes[i, 2, d]


@compiled
def _search(n, shorter, axes, arms, load, good, forces, press, slide, unknowns):
    """Write the balances of all contact sets, and whether each has one, as `critical._search`."""
    b, f = arms.shape[:2]
    cones = ConeArrays(np.empty((f, 8, 3)), np.empty(8))
    at = BalanceArrays(np.empty((f, 3)), np.empty((f, 3)), np.empty(8))
    changes = ChangeArrays(np.empty((2, f, 3)), np.empty((2, 2, f, 3)), np.empty((2, 8)))
    scaling = ScalingArrays(
        np.empty((2, f, 3)),
        np.empty((2, f)),
        np.empty((f, 3)),
        np.empty(f),
        np.empty((f, 10, 3)),
        np.empty((8, 10)),
    )
    gram = np.empty((6, 7))
    for g in range(b):
        _of_contacts(axes[g], arms[g], load[g], cones)
        _first(n, cones, at, gram)
        good[g] = _balance(n, shorter, cones, at, scaling, changes)
        if good[g]:
            _along(at, axes[g], forces[g], press[g], slide[g])
            for r in range(8):
                unknowns[g, r] = at.unknowns[r]


def search(
    points: Vectors, axes: Float[Tensor, "b f 3 3"], load: Float[Tensor, "b 6"], numbers: Any
) -> tuple[Bool[Tensor, "b"], tuple[Tensor, ...]]:
    """Return a mask of the contact sets that can balance, and the balances of all sets: the fields
    of `critical.LeastBalance`, in its order.

    The balances of sets that cannot balance mean nothing. `points` (b, f, 3) are the contacts. The
    rows of `axes` (b, f, 3, 3) are the inward normal and two tangents at each contact. `load` (b,
    6) is the wrench that the contacts balance: force, then torque about their centroid. Its forces
    are divided by the mean normal force, and its lengths by the contacts' root-mean-square radius.
    `numbers` are `critical.CRITICAL`.
    """
    b, f = points.shape[:2]
    values = SearchNumbers(*(getattr(numbers, name) for name in SearchNumbers._fields))
    good = torch.zeros(b, dtype=torch.bool)
    forces = points.new_zeros(b, f, 3)
    press = points.new_zeros(b, f)
    slide = points.new_zeros(b, f, 3)
    unknowns = points.new_zeros(b, 8)
    given = np.array(numbers.shorter), array(axes), array(scaled_arms(points)), array(load)
    found = good, forces, press, slide, unknowns
    with np.errstate(all="ignore"):  # sets that cannot balance end with NaN
        _search(values, *given, *(x.numpy() for x in found))
    twist, scale, friction = unknowns.split([6, 1, 1], 1)
    return good, (forces, friction[:, 0], press, slide, twist, scale[:, 0])
