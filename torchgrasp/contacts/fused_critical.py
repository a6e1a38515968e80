"""The search of `torchgrasp.contacts.critical` for the least friction as one compiled loop over
contact sets.

Four sets are computed side by side, each in its lane, so that one vector instruction serves them
all. A set that has ended leaves its lane to the next one. All numbers are in one array (rows,
contacts, lanes), at rows that are constants, since the compiler then knows that they are apart. A
number of a whole set is in the entry of its first contact.
"""

import collections
import math

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.contacts import critical
from torchgrasp.contacts.form_closure import Vectors, scaled_arms
from torchgrasp.foundation.fused import array, compiled, inlined
from torchgrasp.geometry.fused_vectors import add, dot, scale

NUMBERS = (
    "most exact steps first above pushing within power short stuck raised off polishing rounding"
)
SearchNumbers = collections.namedtuple("SearchNumbers", NUMBERS.split())
"""Numbers of `CriticalNumbers` of the same names."""
PARTS = (
    "rows forces multipliers friction motion loose target share solved by_friction soft stiff "
    "beta form lacking pressed inverse change matrix right product nearest room work"
)
EachContact = collections.namedtuple("EachContact", PARTS.split())
"""Rows of numbers of contacts. They are, in the names of `_Cones.directions`:

* `rows`, row r of axis c at 6 c + r, but for the last two;
* `forces` and `multipliers` (3);
* `friction`, `motion` (7), `target`, `share`, and whether the friction is `loose`, that is, not
  held: copies of those of the set;
* `solved` (8, 2): a copy of the set's unknowns, at 2 r + 1 for each unit of nu;
* `by_friction`, `soft`, `stiff`, `lacking` (3), `beta`, and the `form` of x and s (2);
* `pressed` (3): the free forces for each unit of nu;
* `inverse` of x (3);
* `change` of forces, x and s (3, 2, 3), each to nu = 0 and for each unit of nu;
* `matrix` (8, 8) and `right` (8, 2): parts of the equations of the set;
* `product` of x and s, the inverse of the longest share, `nearest`, and parts of `room` and `work`.
"""
EachSet = collections.namedtuple(
    "EachSet", "friction motion constants last loose mean target share nearest room work"
)
"""Rows of numbers of contact sets. They are those of `_search` of `critical`, and also:

* `constants` (8) of the equations;
* `room`: positive where the forces stay in the cones after a share;
* `work`: the sum of the normal forces with their multipliers, which should be 1.
"""


@inlined
def _each_contact(scratch):
    """Return the rows of numbers of contacts."""
    return EachContact(
        scratch[0:18],
        scratch[18:21],
        scratch[21:24],
        scratch[24],
        scratch[25:32],
        scratch[32],
        scratch[33],
        scratch[34],
        scratch[35:51],
        scratch[51:54],
        scratch[54:57],
        scratch[57:60],
        scratch[60],
        scratch[61:63],
        scratch[63:66],
        scratch[66:69],
        scratch[69:72],
        scratch[72:90],
        scratch[90:154],
        scratch[154:170],
        scratch[170],
        scratch[171],
        scratch[172],
        scratch[173],
    )


@inlined
def _each_set(scratch):
    """Return the rows of numbers of contact sets."""
    first = scratch[:, 0]
    return EachSet(
        first[174],
        first[175:182],
        first[182:190],
        first[190],
        first[191],
        first[192],
        first[193],
        first[194],
        first[195],
        first[196],
        first[197],
    )


@inlined
def _spread(row, k, value):
    """Write a number of a set for each of its contacts, of which there are at most five."""
    row[0, k] = value
    row[1, k] = value
    row[2, k] = value
    row[3, k] = value
    row[4, k] = value


@inlined
def _sum(row, k):
    """Return a sum over contacts; those that a set lacks are 0."""
    return row[0, k] + row[1, k] + row[2, k] + row[3, k] + row[4, k]


@inlined
def _greatest(row, k):
    """Return the greatest number of all contacts."""
    return max(max(max(row[0, k], row[1, k]), max(row[2, k], row[3, k])), row[4, k])


@inlined
def _least(row, k):
    """Return the least number of all contacts."""
    return min(min(min(row[0, k], row[1, k]), min(row[2, k], row[3, k])), row[4, k])


@inlined
def _sums(matrix, r, q, k):
    """Return the sums over contacts of the numbers q, q + 1 and q + 2 of row r of a matrix."""
    at = 8 * r + q
    return _sum(matrix[at], k), _sum(matrix[at + 1], k), _sum(matrix[at + 2], k)


@inlined
def _row(rows, r, i, k):
    """Return the row r of the contact, over its axes."""
    return rows[r, i, k], rows[6 + r, i, k], rows[12 + r, i, k]


@inlined
def _vector(rows, first, i, k):
    """Return three numbers of a contact."""
    return rows[first, i, k], rows[first + 1, i, k], rows[first + 2, i, k]


@inlined
def _put(rows, first, i, k, v):
    """Write three numbers of a contact."""
    rows[first, i, k] = v[0]
    rows[first + 1, i, k] = v[1]
    rows[first + 2, i, k] = v[2]


@inlined
def _put_products(matrix, r, q, i, k, z, vectors):
    """Write the products of z with three vectors into row r, from column q on."""
    _put(matrix, 8 * r + q, i, k, (dot(z, vectors[0]), dot(z, vectors[1]), dot(z, vectors[2])))


@inlined
def _factor(a, b, c):
    """Return the factor of a symmetric matrix with these rows: inverse pivots, and what is below."""
    first = 1.0 / a[0]
    low = b[0] * first
    lowest = c[0] * first
    second = 1.0 / (b[1] - low * b[0])
    across = c[1] - lowest * b[0]
    last = across * second
    third = 1.0 / (c[2] - lowest * c[0] - last * across)
    return first, second, third, low, lowest, last


@inlined
def _solved(factor, v):
    """Return the solution for a vector v."""
    first, second, third, low, lowest, last = factor
    y = v[1] - low * v[0]
    z = third * (v[2] - lowest * v[0] - last * y)
    y = second * y - last * z
    return first * v[0] - low * y - lowest * z, y, z


@inlined
def _less(v, w, a, b, c):
    """Return v minus the products of w with the vectors a, b and c."""
    return v[0] - dot(w, a), v[1] - dot(w, b), v[2] - dot(w, c)


@inlined
def _soften(u, beta, by_mu, z):
    """Return the product of a vector with M^-1 D^-1 M^-1."""
    along = dot(u, z)
    first = along * u[0] - beta * by_mu * by_mu * z[0]
    return first, along * u[1] + beta * z[1], along * u[2] + beta * z[2]


@inlined
def _solve(each, common):
    """Solve the eight equations of all sets, by blocks of three, three and two."""
    matrix = each.matrix
    right = each.right
    constants = common.constants
    for k in range(4):
        one = _factor(_sums(matrix, 0, 0, k), _sums(matrix, 1, 0, k), _sums(matrix, 2, 0, k))
        v3 = _sums(matrix, 3, 0, k)
        v4 = _sums(matrix, 4, 0, k)
        v5 = _sums(matrix, 5, 0, k)
        v6 = _sums(matrix, 6, 0, k)
        v7 = _sums(matrix, 7, 0, k)
        w3 = _solved(one, v3)
        w4 = _solved(one, v4)
        w5 = _solved(one, v5)
        w6 = _solved(one, v6)
        w7 = _solved(one, v7)
        b0 = _sum(right[0], k) + constants[0, k]
        b1 = _sum(right[2], k) + constants[1, k]
        b2 = _sum(right[4], k) + constants[2, k]
        g = _solved(one, (b0, b1, b2))
        h = _solved(one, (_sum(right[1], k), _sum(right[3], k), _sum(right[5], k)))
        # what is left of the equations 3 to 7
        m3 = _less(_sums(matrix, 3, 3, k), v3, w3, w4, w5)
        m4 = _less(_sums(matrix, 4, 3, k), v4, w3, w4, w5)
        m5 = _less(_sums(matrix, 5, 3, k), v5, w3, w4, w5)
        m6 = _less(_sums(matrix, 6, 3, k), v6, w3, w4, w5)
        m7 = _less(_sums(matrix, 7, 3, k), v7, w3, w4, w5)
        b3 = _sum(right[6], k) + constants[3, k] - dot(v3, g)
        b4 = _sum(right[8], k) + constants[4, k] - dot(v4, g)
        b5 = _sum(right[10], k) + constants[5, k] - dot(v5, g)
        b6 = _sum(right[12], k) + constants[6, k] - dot(v6, g)
        b7 = _sum(right[14], k) + constants[7, k] - dot(v7, g)
        c3 = _sum(right[7], k) - dot(v3, h)
        c4 = _sum(right[9], k) - dot(v4, h)
        c5 = _sum(right[11], k) - dot(v5, h)
        c6 = _sum(right[13], k) - dot(v6, h)
        c7 = _sum(right[15], k) - dot(v7, h)
        loose = common.loose[k]
        two = _factor(m3, m4, m5)
        y6 = _solved(two, m6)
        y7 = _solved(two, m7)
        p = _solved(two, (b3, b4, b5))
        q = _solved(two, (c3, c4, c5))
        pivot = 1.0 / (_sum(matrix[54], k) - dot(v6, w6) - dot(m6, y6))
        low = _sum(matrix[62], k) - dot(v7, w6) - dot(m7, y6)
        last = _sum(matrix[63], k) - dot(v7, w7) - dot(m7, y7) - low * pivot * low
        x6 = b6 - dot(m6, p)
        z6 = c6 - dot(m6, q)
        x7 = loose * (b7 - dot(m7, p) - low * pivot * x6) / last
        z7 = loose * (c7 - dot(m7, q) - low * pivot * z6) / last
        x6 = pivot * (x6 - low * x7)
        z6 = pivot * (z6 - low * z7)
        p = add(add(p, y6, -x6), y7, -x7)
        q = add(add(q, y6, -z6), y7, -z7)
        g = add(add(add(add(add(g, w3, -p[0]), w4, -p[1]), w5, -p[2]), w6, -x6), w7, -x7)
        h = add(add(add(add(add(h, w3, -q[0]), w4, -q[1]), w5, -q[2]), w6, -z6), w7, -z7)
        solved = each.solved
        _spread(solved[0], k, g[0])
        _spread(solved[1], k, h[0])
        _spread(solved[2], k, g[1])
        _spread(solved[3], k, h[1])
        _spread(solved[4], k, g[2])
        _spread(solved[5], k, h[2])
        _spread(solved[6], k, p[0])
        _spread(solved[7], k, q[0])
        _spread(solved[8], k, p[1])
        _spread(solved[9], k, q[1])
        _spread(solved[10], k, p[2])
        _spread(solved[11], k, q[2])
        _spread(solved[12], k, x6)
        _spread(solved[13], k, z6)
        _spread(solved[14], k, x7)
        _spread(solved[15], k, z7)
        common.mean[k] = _sum(each.product, k)


@inlined
def _write_equations(f, each):
    """Write the scaling of all contacts, and their parts of the equations."""
    matrix = each.matrix
    right = each.right
    for i in range(f):
        for k in range(4):
            mu = each.friction[i, k]
            push, x1, x2 = _vector(each.forces, 0, i, k)
            x0 = mu * push
            s0, s1, s2 = _vector(each.multipliers, 0, i, k)
            form_x = x0 * x0 - x1 * x1 - x2 * x2
            form_s = s0 * s0 - s1 * s1 - s2 * s2
            by_mu = 1.0 / mu
            by_x = 1.0 / form_x
            by_s = 1.0 / form_s
            unit_x = np.sqrt(by_x)
            unit_s = np.sqrt(by_s)
            beta = unit_s * form_x * unit_x
            by_beta = unit_x * form_s * unit_s
            product = x0 * s0 + x1 * s1 + x2 * s2
            gain = 1.0 + product * unit_x * unit_s
            w0 = x0 * unit_x + s0 * unit_s
            w1 = x1 * unit_x - s1 * unit_s
            w2 = x2 * unit_x - s2 * unit_s
            wide = np.sqrt(by_beta / gain)
            narrow = beta * wide
            t0 = wide * w0
            t1 = -wide * w1
            t2 = -wide * w2
            u = narrow * w0 * by_mu, narrow * w1, narrow * w2
            loose = each.loose[i, k]
            z7 = (
                loose * (x0 * t0 * t0 - s0 - x0 * by_beta),
                loose * push * t0 * t1,
                loose * push * t0 * t2,
            )
            z0 = _row(each.rows, 0, i, k)
            z1 = _row(each.rows, 1, i, k)
            z2 = _row(each.rows, 2, i, k)
            z3 = _row(each.rows, 3, i, k)
            z4 = _row(each.rows, 4, i, k)
            z5 = _row(each.rows, 5, i, k)
            lacking = mu * s0 + each.motion[6, i, k], s1, s2
            lacking = add(lacking, z0, -each.motion[0, i, k])
            lacking = add(lacking, z1, -each.motion[1, i, k])
            lacking = add(lacking, z2, -each.motion[2, i, k])
            lacking = add(lacking, z3, -each.motion[3, i, k])
            lacking = add(lacking, z4, -each.motion[4, i, k])
            lacking = add(lacking, z5, -each.motion[5, i, k])
            free = _soften(u, beta, by_mu, lacking)
            pressed = s0 * by_s * by_mu, -s1 * by_s, -s2 * by_s
            y0 = _soften(u, beta, by_mu, z0)
            y1 = _soften(u, beta, by_mu, z1)
            y2 = _soften(u, beta, by_mu, z2)
            y3 = _soften(u, beta, by_mu, z3)
            y4 = _soften(u, beta, by_mu, z4)
            y5 = _soften(u, beta, by_mu, z5)
            y7 = _soften(u, beta, by_mu, z7)
            y = y0, y1, y2
            t = y3, y4, y5
            _put_products(matrix, 0, 0, i, k, z0, y)
            _put_products(matrix, 1, 0, i, k, z1, y)
            _put_products(matrix, 2, 0, i, k, z2, y)
            _put_products(matrix, 3, 0, i, k, z3, y)
            _put_products(matrix, 3, 3, i, k, z3, t)
            _put_products(matrix, 4, 0, i, k, z4, y)
            _put_products(matrix, 4, 3, i, k, z4, t)
            _put_products(matrix, 5, 0, i, k, z5, y)
            _put_products(matrix, 5, 3, i, k, z5, t)
            _put_products(matrix, 6, 0, i, k, (-1.0, 0.0, 0.0), y)
            _put_products(matrix, 6, 3, i, k, (-1.0, 0.0, 0.0), t)
            _put_products(matrix, 7, 0, i, k, z7, y)
            _put_products(matrix, 7, 3, i, k, z7, t)
            matrix[54, i, k] = u[0] * u[0] - beta * by_mu * by_mu
            matrix[62, i, k] = -y7[0]
            matrix[63, i, k] = dot(z7, y7) - push * push * (t0 * t0 - by_beta)
            right[0, i, k] = dot(z0, free)
            right[1, i, k] = dot(z0, pressed)
            right[2, i, k] = dot(z1, free)
            right[3, i, k] = dot(z1, pressed)
            right[4, i, k] = dot(z2, free)
            right[5, i, k] = dot(z2, pressed)
            right[6, i, k] = dot(z3, free)
            right[7, i, k] = dot(z3, pressed)
            right[8, i, k] = dot(z4, free)
            right[9, i, k] = dot(z4, pressed)
            right[10, i, k] = dot(z5, free)
            right[11, i, k] = dot(z5, pressed)
            right[12, i, k] = -free[0]
            right[13, i, k] = -pressed[0]
            right[14, i, k] = dot(z7, free)
            right[15, i, k] = dot(z7, pressed) - push * x0 * by_x
            _put(each.by_friction, 0, i, k, z7)
            _put(each.soft, 0, i, k, u)
            _put(each.stiff, 0, i, k, (t0, t1, t2))
            _put(each.lacking, 0, i, k, lacking)
            _put(each.pressed, 0, i, k, pressed)
            _put(each.inverse, 0, i, k, (x0 * by_x, -x1 * by_x, -x2 * by_x))
            each.beta[i, k] = beta
            each.form[0, i, k] = form_x
            each.form[1, i, k] = form_s
            each.product[i, k] = product / (2 * f)


@inlined
def _pull(each, h, i, k):
    """Return what the solved unknowns make of the contact's multiplier."""
    rows = each.rows
    solved = each.solved
    total = -solved[12 + h, i, k], 0.0, 0.0
    total = add(total, _row(rows, 0, i, k), solved[h, i, k])
    total = add(total, _row(rows, 1, i, k), solved[2 + h, i, k])
    total = add(total, _row(rows, 2, i, k), solved[4 + h, i, k])
    total = add(total, _row(rows, 3, i, k), solved[6 + h, i, k])
    total = add(total, _row(rows, 4, i, k), solved[8 + h, i, k])
    total = add(total, _row(rows, 5, i, k), solved[10 + h, i, k])
    return add(total, _vector(each.by_friction, 0, i, k), solved[14 + h, i, k])


@inlined
def _put_change(each, h, i, k, forces, constant):
    """Write the change of a contact's forces, and the change of x and s that follows."""
    change = each.change
    stiff = _vector(each.stiff, 0, i, k)
    first = each.friction[i, k] * forces[0] + each.forces[0, i, k] * each.solved[14 + h, i, k]
    of_x = first, forces[1], forces[2]
    along = dot(stiff, of_x)
    by_beta = 1.0 / each.beta[i, k]
    of_s = by_beta * of_x[0], -by_beta * of_x[1], -by_beta * of_x[2]
    of_s = add(add(of_s, stiff, -along), constant, 1.0)
    _put(change, 3 * h, i, k, forces)
    _put(change, 6 + 3 * h, i, k, of_x)
    _put(change, 12 + 3 * h, i, k, of_s)


@inlined
def _direct(f, each):
    """Write the changes of forces, x and s, to nu = 0 and for each unit of nu."""
    for i in range(f):
        for k in range(4):
            u = _vector(each.soft, 0, i, k)
            beta = each.beta[i, k]
            by_mu = 1.0 / each.friction[i, k]
            lacking = add(_vector(each.lacking, 0, i, k), _pull(each, 0, i, k), -1.0)
            still = _soften(u, beta, by_mu, lacking)
            still = add(still, _vector(each.forces, 0, i, k), -1.0)
            multipliers = _vector(each.multipliers, 0, i, k)
            _put_change(each, 0, i, k, still, scale(multipliers, -1.0))
            pulled = _soften(u, beta, by_mu, _pull(each, 1, i, k))
            centring = add(_vector(each.pressed, 0, i, k), pulled, -1.0)
            _put_change(each, 1, i, k, centring, _vector(each.inverse, 0, i, k))


@inlined
def _nearest(form, x, d):
    """Return the inverse of the longest share of the change d for which x stays in its cone."""
    along = x[0] * d[0] - x[1] * d[1] - x[2] * d[2]
    bend = d[0] * d[0] - d[1] * d[1] - d[2] * d[2]
    root = np.sqrt(max(along * along - form * bend, 0.0))
    return (root - along) / form


@inlined
def _find_longest(f, each, common):
    """Write the inverse of the longest share of each set, as `_Scaling.longest`; 0 if infinite."""
    change = each.change
    for i in range(f):
        for k in range(4):
            push, x1, x2 = _vector(each.forces, 0, i, k)
            x = each.friction[i, k] * push, x1, x2
            target = each.target[i, k]
            of_x = add(_vector(change, 6, i, k), _vector(change, 9, i, k), target)
            of_s = add(_vector(change, 12, i, k), _vector(change, 15, i, k), target)
            s = _vector(each.multipliers, 0, i, k)
            by_x = _nearest(each.form[0, i, k], x, of_x)
            each.nearest[i, k] = max(by_x, _nearest(each.form[1, i, k], s, of_s))
    for k in range(4):
        common.nearest[k] = max(_greatest(each.nearest, k), 0.0)


@inlined
def _find_room(f, each, common):
    """Write numbers that are positive where all forces stay in the cones after the shares."""
    for k in range(4):
        _spread(each.share, k, common.share[k])
    for i in range(f):
        for k in range(4):
            target = each.target[i, k]
            share = each.share[i, k]
            by_share = each.solved[14, i, k] + target * each.solved[15, i, k]
            friction = each.friction[i, k] + share * by_share
            step = add(_vector(each.change, 0, i, k), _vector(each.change, 3, i, k), target)
            push, one, two = add(_vector(each.forces, 0, i, k), step, share)
            x = friction * push
            room = min(friction, push)
            each.room[i, k] = min(room, x * x - one * one - two * two)
    for k in range(4):
        common.room[k] = _least(each.room, k)


@inlined
def _is_inside(f, each, common, share, k):
    """Return whether the forces in lane k stay in the cones after a share of the change."""
    target = common.target[k]
    by_share = each.solved[14, 0, k] + target * each.solved[15, 0, k]
    friction = common.friction[k] + share * by_share
    inside = friction > 0.0
    for i in range(f):
        step = add(_vector(each.change, 0, i, k), _vector(each.change, 3, i, k), target)
        push, one, two = add(_vector(each.forces, 0, i, k), step, share)
        x = friction * push
        inside = inside and push > 0.0 and x * x > one * one + two * two
    return inside


@inlined
def _after(f, each, common):
    """Go a share of the change, as `_Balance.after`."""
    change = each.change
    for k in range(4):
        _spread(each.share, k, common.share[k])
    for i in range(f):
        for k in range(4):
            share = each.share[i, k]
            target = each.target[i, k]
            step = add(_vector(change, 0, i, k), _vector(change, 3, i, k), target)
            forces = add(_vector(each.forces, 0, i, k), step, share)
            step = add(_vector(change, 12, i, k), _vector(change, 15, i, k), target)
            multipliers = add(_vector(each.multipliers, 0, i, k), step, share)
            _put(each.forces, 0, i, k, forces)
            _put(each.multipliers, 0, i, k, multipliers)
            each.work[i, k] = forces[0] * multipliers[0]
    for k in range(4):
        common.work[k] = _sum(each.work, k)
    for r in range(8):
        for k in range(4):
            step = each.solved[2 * r, 0, k] + common.target[k] * each.solved[2 * r + 1, 0, k]
            if r < 7:
                common.motion[r, k] += common.share[k] * step
            else:
                common.friction[k] += common.share[k] * step


@inlined
def _put_set(each, common, axes, arms, load, k):
    """Write the rows and the constants of a contact set into lane k, as `_Cones.of`."""
    f = len(arms)
    for i in range(f):
        arm = arms[i]
        for c in range(3):
            a = axes[i, c]
            each.rows[6 * c, i, k] = a[0]
            each.rows[6 * c + 1, i, k] = a[1]
            each.rows[6 * c + 2, i, k] = a[2]
            each.rows[6 * c + 3, i, k] = arm[1] * a[2] - arm[2] * a[1]
            each.rows[6 * c + 4, i, k] = arm[2] * a[0] - arm[0] * a[2]
            each.rows[6 * c + 5, i, k] = arm[0] * a[1] - arm[1] * a[0]
    for r in range(6):
        common.constants[r, k] = load[r]
    common.constants[6, k] = f
    common.constants[7, k] = 1.0


@inlined
def _start(n, f, each, common):
    """Write the start of all lanes, as `_Cones.first`."""
    matrix = each.matrix
    for i in range(f):
        for k in range(4):
            z0 = _row(each.rows, 0, i, k)
            z1 = _row(each.rows, 1, i, k)
            z2 = _row(each.rows, 2, i, k)
            z3 = _row(each.rows, 3, i, k)
            z4 = _row(each.rows, 4, i, k)
            z5 = _row(each.rows, 5, i, k)
            y = z0, z1, z2
            t = z3, z4, z5
            _put_products(matrix, 0, 0, i, k, z0, y)
            _put_products(matrix, 1, 0, i, k, z1, y)
            _put_products(matrix, 2, 0, i, k, z2, y)
            _put_products(matrix, 3, 0, i, k, z3, y)
            _put_products(matrix, 3, 3, i, k, z3, t)
            _put_products(matrix, 4, 0, i, k, z4, y)
            _put_products(matrix, 4, 3, i, k, z4, t)
            _put_products(matrix, 5, 0, i, k, z5, y)
            _put_products(matrix, 5, 3, i, k, z5, t)
            # the other two equations are those of two more unknowns, which do not count
            matrix[54, i, k] = 1.0
            matrix[63, i, k] = 1.0
            each.right[0, i, k] = z0[0]
            each.right[2, i, k] = z1[0]
            each.right[4, i, k] = z2[0]
            each.right[6, i, k] = z3[0]
            each.right[8, i, k] = z4[0]
            each.right[10, i, k] = z5[0]
    _solve(each, common)
    for i in range(f):
        for k in range(4):
            # without the pull of the equation of the sum
            pull = _pull(each, 0, i, k)
            push = 1.0 - each.solved[12, i, k] - pull[0]
            _put(each.forces, 0, i, k, (push, -pull[1], -pull[2]))
            each.room[i, k] = push
    for k in range(4):
        _spread(each.share, k, 1.0 if _least(each.room, k) > n.pushing else 0.0)
    for i in range(f):
        for k in range(4):
            push, one, two = _vector(each.forces, 0, i, k)
            pushes = each.share[i, k]
            push = push if pushes > 0.0 else 1.0
            _put(each.forces, 0, i, k, (push, pushes * one, pushes * two))
            each.work[i, k] = push
            each.nearest[i, k] = pushes * np.sqrt(one * one + two * two) / push
    for k in range(4):
        _spread(each.target, k, f / _sum(each.work, k))
        common.friction[k] = n.first * _greatest(each.nearest, k) + n.above
        _spread(each.friction, k, common.friction[k])
    for i in range(f):
        for k in range(4):
            push, one, two = scale(_vector(each.forces, 0, i, k), each.target[i, k])
            _put(each.forces, 0, i, k, (push, one, two))
            x = each.friction[i, k] * push
            form = x * x - one * one - two * two
            _put(each.multipliers, 0, i, k, (x / form, -one / form, -two / form))
            each.work[i, k] = push * x / form
    for k in range(4):
        nu = 1.0 / _sum(each.work, k)
        _spread(each.target, k, nu)
        common.motion[6, k] = -2.0 * nu
    for i in range(f):
        for k in range(4):
            multipliers = scale(_vector(each.multipliers, 0, i, k), each.target[i, k])
            _put(each.multipliers, 0, i, k, multipliers)


@inlined
def _balances(n, f, each, common, k):
    """Return whether the forces in lane k balance, and the friction is not too large."""
    square = 0.0
    for r in range(6):
        total = common.constants[r, k]
        for i in range(f):
            total += dot(_row(each.rows, r, i, k), _vector(each.forces, 0, i, k))
        square += total * total
    return np.sqrt(square) <= n.rounding and common.friction[k] <= n.most


@inlined
def _write(each, common, k, axes, forces, press, slide, motion):
    """Write the balance in lane k, as `_Balance.along`."""
    for i in range(len(axes)):
        force = _vector(each.forces, 0, i, k)
        press[i], one, two = _vector(each.multipliers, 0, i, k)
        for d in range(3):
            forces[i, d] = dot(force, axes[i, :, d])
            slide[i, d] = one * axes[i, 1, d] + two * axes[i, 2, d]
    for r in range(7):
        motion[r] = common.motion[r, k]


@compiled
def _search(n, shorter, axes, arms, load, good, forces, friction, press, slide, motion):
    """Write the balances of all contact sets, and whether each has one, as `critical._search`."""
    b, f = arms.shape[:2]
    scratch = np.zeros((198, 5, 4))
    begun = np.zeros((198, 5, 4))
    each = _each_contact(scratch)
    common = _each_set(scratch)
    next_each = _each_contact(begun)
    next_common = _each_set(begun)
    each.room[:] = math.inf  # of contacts that a set lacks
    next_each.room[:] = math.inf
    owner = np.full(4, -1)
    step = np.zeros(4, np.int64)
    polished = np.zeros(4, np.int64)
    taken = 0
    started = 0
    running = 0
    while taken < b or running > 0:
        for k in range(4):
            # the first sets fill all lanes, so that each holds numbers that can be divided by
            if owner[k] >= 0 or (taken == b and step[k] > 0):
                continue
            if taken == started and taken < b:
                for j in range(4):
                    g = min(started + j, b - 1)
                    _put_set(next_each, next_common, axes[g], arms[g], load[g], j)
                _start(n, f, next_each, next_common)
                started = min(started + 4, b)
            j = taken % 4
            for i in range(f):
                for c in range(24):
                    scratch[c, i, k] = begun[c, i, j]
            for c in range(174, 190):
                scratch[c, 0, k] = begun[c, 0, j]
            step[k] = 0
            polished[k] = 0
            common.last[k] = 1.0
            if taken < b:
                owner[k] = taken
                taken += 1
                running += 1
        for k in range(4):
            common.loose[k] = 1.0 if common.last[k] >= n.short else 0.0
            _spread(each.friction, k, common.friction[k])
            _spread(each.loose, k, common.loose[k])
            _spread(each.target, k, 0.0)
            _spread(each.motion[0], k, common.motion[0, k])
            _spread(each.motion[1], k, common.motion[1, k])
            _spread(each.motion[2], k, common.motion[2, k])
            _spread(each.motion[3], k, common.motion[3, k])
            _spread(each.motion[4], k, common.motion[4, k])
            _spread(each.motion[5], k, common.motion[5, k])
            _spread(each.motion[6], k, common.motion[6, k])
        _write_equations(f, each)
        _solve(each, common)
        _direct(f, each)
        for turn in range(2):
            _find_longest(f, each, common)
            if turn == 0:
                for k in range(4):
                    undone = 1.0 - 1.0 / max(common.nearest[k], 1.0)
                    kept = 1.0 if common.loose[k] == 0.0 else undone**n.power
                    target = max(kept * common.mean[k], n.exact)
                    common.target[k] = n.exact if polished[k] > 0 else target
                    _spread(each.target, k, common.target[k])
        for k in range(4):
            share = n.within / max(common.nearest[k], n.within)
            common.share[k] = 1.0 if polished[k] > 0 else share * shorter[0]
        _find_room(f, each, common)
        for k in range(4):
            inside = common.room[k] > 0.0
            if owner[k] < 0:
                common.share[k] = 0.0
            elif polished[k] > 0:
                if not (inside and common.nearest[k] < 1.0):
                    common.share[k] = 0.0
            elif not inside:
                share = common.share[k] / shorter[0]
                for q in range(1, len(shorter)):
                    if _is_inside(f, each, common, share * shorter[q], k):
                        common.share[k] = share * shorter[q]
                        break
        _after(f, each, common)
        for k in range(4):
            step[k] += 1
            if owner[k] < 0:
                continue
            g = owner[k]
            if polished[k] > 0:
                polished[k] += 1
                if polished[k] > n.polishing:
                    good[g] = True
                    friction[g] = common.friction[k]
                    parts = forces[g], press[g], slide[g], motion[g]
                    _write(each, common, k, axes[g], *parts)
                    owner[k] = -1
                    running -= 1
                continue
            share = common.share[k]
            if common.loose[k] == 0.0 and share < n.stuck:
                common.friction[k] *= n.raised
            off = abs(common.work[k] - 1.0)
            settled = share == 1.0 and common.target[k] == n.exact and off <= n.off
            common.last[k] = share
            if settled and _balances(n, f, each, common, k):
                polished[k] = 1
                common.last[k] = 1.0
            elif settled or not common.friction[k] < 2.0 * n.most or step[k] == n.steps:
                owner[k] = -1
                running -= 1


def search(
    points: Vectors, axes: Float[Tensor, "b f 3 3"], load: Float[Tensor, "b 6"]
) -> tuple[Bool[Tensor, "b"], "critical.LeastBalance"]:
    """Return a mask of the contact sets that can balance, and the balances of all sets.

    Those of other sets mean nothing. The `axes` are those of `_Cones`.
    """
    b, f = points.shape[:2]
    numbers = critical.CRITICAL
    values = SearchNumbers(*(getattr(numbers, name) for name in SearchNumbers._fields))
    good = torch.zeros(b, dtype=torch.bool)
    forces = points.new_zeros(b, f, 3)
    friction = points.new_zeros(b)
    press = points.new_zeros(b, f)
    slide = points.new_zeros(b, f, 3)
    motion = points.new_zeros(b, 7)
    given = np.array(numbers.shorter), array(axes), array(scaled_arms(points)), array(load)
    found = good, forces, friction, press, slide, motion
    with np.errstate(all="ignore"):  # sets that cannot balance end with NaN
        _search(values, *given, *(x.numpy() for x in found))
    twist, scale = motion.split([6, 1], 1)
    return good, critical.LeastBalance(forces, friction, press, slide, twist, scale[:, 0])
