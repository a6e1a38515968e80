"""A stage of the contact solver (`torchgrasp.contacts.solver.descend`) as one compiled loop over
contact sets.

The loop computes the constraints of `ContactProblem`, and the steps of `levenberg_marquardt` with
`Descent`. It takes stages that are not exact, on one shape with one surface or two walls, and a
thin-plate kernel. It takes neither a region nor an edge of the table.
"""

import collections
import math

import numpy as np
import torch

from torchgrasp.contacts import descent
from torchgrasp.contacts import problem as constraint
from torchgrasp.foundation.fused import array, compiled, inlined
from torchgrasp.geometry.fused_vectors import (
    add,
    copy,
    dot,
    factorise,
    put,
    scale,
    solve_factorised,
)
from torchgrasp.shape.estimate import SurfaceJet
from torchgrasp.shape.fused_jets import put_hessian, sum_thin_plate
from torchgrasp.shape.gp import ShapeGP

NUMBERS = (
    "steps settled centre surface cones bounds damping_of_tensions longest first least most "
    "cone threshold half_slope ball domain apart tip room height"
)
DescentNumbers = collections.namedtuple("DescentNumbers", NUMBERS.split())
"""Numbers of the stage and the solver, then those of the constraints, as `constraints` names them."""


@inlined
def _force(i, points, tension, pairs, signs):
    """Return the force at contact i, as `forces_from_tensions`."""
    force = (0.0, 0.0, 0.0)
    for k in range(len(tension)):
        pull = signs[i, k] * tension[k]
        force = add(add(force, points[pairs[1, k]], pull), points[pairs[0, k]], -pull)
    return force


@inlined
def _constrain(n, contacts, pairs, signs, up, room, value, jacobian):
    """Write constraints and Jacobian, as `ContactProblem.constraints`; return whether all contacts
    are inside the domain.
    """
    points, tension, distance, gradient, hessian, variance, slope = contacts
    normals, rolled = room
    f = len(points)
    p = len(tension)
    jacobian[:] = 0.0
    value[:3] = 0.0
    inside = True
    for i in range(f):
        x = points[i]
        own = slice(3 * i, 3 * i + 3)
        steep = math.sqrt(dot(gradient[i], gradient[i]))
        put(normals[i], scale(gradient[i], 1 / steep))
        # the tip's centre moves by 1 + radius (1 - n n^T) H / |g|
        for c in range(3):
            along = dot(normals[i], hessian[i, :, c])
            for r in range(3):
                bend = (hessian[i, r, c] - normals[i, r] * along) / steep
                rolled[i, r, c] = n.tip * bend + (r == c)
        square = dot(x, x)
        inside = inside and math.sqrt(square) < n.domain
        for r in range(3):
            value[r] += x[r] / f
            jacobian[r, 3 * i + r] = 1 / f
        value[3 + i] = distance[i]
        put(jacobian[3 + i, own], gradient[i])
        row = 3 + 2 * f + i
        value[row] = (variance[i] - n.threshold) / n.half_slope
        put(jacobian[row, own], scale(slope[i], 1 / n.half_slope))
        row += f
        value[row] = (square - n.ball**2) / (2 * n.ball)
        put(jacobian[row, own], scale(x, 1 / n.ball))
        # the friction cone, as `_cones`
        row = 3 + f + i
        force = _force(i, points, tension, pairs, signs)
        size = math.sqrt(dot(force, force))
        force = scale(force, 1 / size)
        outward = dot(normals[i], force)
        by_force = scale(add(normals[i], force, -outward), 1 / size)
        across = scale(add(force, normals[i], -outward), 1 / steep)
        value[row] = outward + n.cone
        for c in range(3):
            jacobian[row, 3 * i + c] = dot(across, hessian[i, :, c])
        for k in range(p):
            if signs[i, k] != 0.0:
                other = pairs[0, k] + pairs[1, k] - i
                for c in range(3):
                    jacobian[row, 3 * i + c] -= tension[k] * by_force[c]
                    jacobian[row, 3 * other + c] += tension[k] * by_force[c]
                side = add(points[pairs[1, k]], points[pairs[0, k]], -1.0)
                jacobian[row, 3 * f + k] = signs[i, k] * dot(by_force, side)
        if len(up):
            row = 3 + 4 * f + p + i
            lean = 1 - dot(normals[i], up)
            value[row] = n.room - (dot(x, up) - n.height - n.tip * lean)
            for c in range(3):
                jacobian[row, 3 * i + c] = -dot(up, rolled[i, :, c])
    for k in range(p):
        row = 3 + 4 * f + k
        i = pairs[0, k]
        j = pairs[1, k]
        side = add(points[j], points[i], -1.0)
        side = add(add(side, normals[j], n.tip), normals[i], -n.tip)
        length = math.sqrt(dot(side, side))
        value[row] = n.apart - length
        for c in range(3):
            jacobian[row, 3 * i + c] = dot(side, rolled[i, :, c]) / length
            jacobian[row, 3 * j + c] = -dot(side, rolled[j, :, c]) / length
    return inside


@inlined
def _weigh(n, f, value, weight, residual):
    """Write weights and residuals, as `Descent.linearise`; return their cost."""
    cost = 0.0
    for r in range(len(value)):
        bound = n.cones if r < 3 + 2 * f else n.bounds
        weight[r] = n.centre if r < 3 else n.surface if r < 3 + f else bound * (value[r] > 0)
        residual[r] = weight[r] * value[r]
        cost += residual[r] * residual[r] / 2
    return cost


@inlined
def _step(n, f, damping, weight, residual, jacobian, matrix, x):
    """Write the step, as `Descent.step`; return whether the contact set goes on."""
    x[:] = 0.0
    matrix[:] = 0.0
    for r in range(len(weight)):
        if weight[r] != 0.0:
            square = weight[r] * weight[r]
            for i in range(len(x)):
                x[i] -= weight[r] * jacobian[r, i] * residual[r]
                for j in range(i + 1):
                    matrix[i, j] += square * jacobian[r, i] * jacobian[r, j]
    for i in range(len(x)):
        matrix[i, i] += damping * (1.0 if i < 3 * f else n.damping_of_tensions)
    if not factorise(matrix):
        return False
    solve_factorised(matrix, x)
    length = 0.0
    for i in range(f):
        part = x[3 * i : 3 * i + 3]
        size = math.sqrt(dot(part, part))
        length = max(length, size) if size == size else size
    shrink = max(length / n.longest, 1.0)
    x /= shrink
    return length / shrink > n.settled


@inlined
def _sum_walls(x, walls, bent):
    """Return the sums of `sum_thin_plate` of the wall with the greater distance at a point x."""
    y, a, b, psi = walls[0]
    found = sum_thin_plate(x, y, a, b, psi, bent)
    y, a, b, psi = walls[1]
    if len(a):
        other = sum_thin_plate(x, y, a, b, psi, bent)
        if other[0] > found[0]:
            found = other
    return found


@inlined
def _move(n, walls, pairs, signs, old, x, new):
    """Write the contacts after a step, as `Descent.move`."""
    points, tension, distance, gradient, hessian, variance, _ = new
    f = len(points)
    for i in range(f):
        put(points[i], add(old[0][i], x[3 * i : 3 * i + 3], 1.0))
        value, slope, _ = _sum_walls(points[i], walls, False)
        newton = scale(slope, -value / dot(slope, slope))
        short = n.longest / max(math.sqrt(dot(newton, newton)), n.longest)
        put(points[i], add(points[i], newton, short))
        distance[i], slope, curved = _sum_walls(points[i], walls, True)
        put(gradient[i], slope)
        put_hessian(hessian[i], curved)
        variance[i] = old[5][i] + dot(old[6][i], add(points[i], old[0][i], -1.0))
    for k in range(len(tension)):
        tension[k] = old[1][k] + x[3 * f + k]
    size = 0.0
    for i in range(f):
        force = _force(i, points, tension, pairs, signs)
        size += math.sqrt(dot(force, force)) / f
    tension /= size


@compiled
def _descend(
    n, walls, pairs, signs, up, points, tension, distance, gradient, hessian, variance, slope
):
    """Minimise the cost of each contact set in place, as `levenberg_marquardt` with `Descent`."""
    b, f = points.shape[:2]
    p = tension.shape[1]
    u = 3 * f + p
    rows = 3 + 4 * f + p + (f if len(up) else 0)
    value = np.empty(rows)
    weight = np.empty(rows)
    residual = np.empty(rows)
    jacobian = np.empty((rows, u))
    other = np.empty((rows, u))
    matrix = np.empty((u, u))
    x = np.empty(u)
    new_weight = np.empty(rows)
    new_residual = np.empty(rows)
    room = np.empty((f, 3)), np.empty((f, 3, 3))
    new = (
        np.empty((f, 3)),
        np.empty(p),
        np.empty(f),
        np.empty((f, 3)),
        np.empty((f, 3, 3)),
        np.empty(f),
        np.empty((f, 3)),
    )
    for s in range(b):
        old = (points[s], tension[s], distance[s], gradient[s], hessian[s], variance[s], slope[s])
        copy(new[6], slope[s])
        _constrain(n, old, pairs, signs, up, room, value, jacobian)
        cost = _weigh(n, f, value, weight, residual)
        damping = n.first
        for _ in range(n.steps):
            if not _step(n, f, damping, weight, residual, jacobian, matrix, x):
                break
            _move(n, walls, pairs, signs, old, x, new)
            inside = _constrain(n, new, pairs, signs, up, room, value, other)
            trial = _weigh(n, f, value, new_weight, new_residual)
            promised = 0.0
            for r in range(rows):
                linear = residual[r]
                for i in range(u):
                    linear += weight[r] * jacobian[r, i] * x[i]
                promised += (residual[r] * residual[r] - linear * linear) / 2
            kept = (cost - trial) / promised
            if kept > 0 and inside:
                eased = min(max(1 - (2 * kept - 1) ** 3, 1 / 5), 2.0)
                damping = max(damping * eased, n.least)
                cost = trial
                copy(points[s], new[0])
                copy(tension[s], new[1])
                copy(distance[s], new[2])
                copy(gradient[s], new[3])
                copy(hessian[s], new[4])
                copy(variance[s], new[5])
                weight, new_weight = new_weight, weight
                residual, new_residual = new_residual, residual
                jacobian, other = other, jacobian
            else:
                damping = min(4 * damping, n.most)
                for k in range(jacobian.size):
                    jacobian.flat[k] = (jacobian.flat[k] + other.flat[k]) / 2


def descend(
    shape: ShapeGP,
    problem: "constraint.ContactProblem",
    state: descent.State,
    stage: descent.Stage,
) -> descent.State:
    """Return the contact sets after the Levenberg-Marquardt steps of one solver stage that begins
    with `state`.

    `shape` is the surface on which the contacts stay. `problem` holds the constraints, and `stage`
    their weights and the greatest number of steps.
    """
    f = state.points.shape[1]
    pairs = constraint.contact_pairs(f, state.points.device)
    signs = constraint.pull_signs(f, state.points.device)
    threshold = problem.spec.max_variance * constraint.INSIDE
    face = problem.table[0] if problem.table else None
    numbers = DescentNumbers(
        stage.steps,
        stage.settled,
        stage.centre,
        descent.SURFACE,
        stage.cones,
        descent.BOUNDS,
        descent.TENSION_DAMPING,
        descent.LONGEST_STEP,
        descent.Descent.first_damping,
        descent.LEAST_DAMPING,
        descent.MOST_DAMPING,
        1 / math.sqrt(1 + problem.friction**2) + constraint.CONE_MARGIN,
        threshold,
        2 * threshold**0.5,
        problem.domain_radius * constraint.INSIDE,
        problem.domain_radius,
        problem.separation / constraint.INSIDE,
        problem.tip_radius,
        (1 - constraint.INSIDE) * constraint.ROOM,
        0.0 if face is None else float(face.offset),
    )
    numbers = DescentNumbers(int(numbers[0]), *map(float, numbers[1:]))
    up = np.zeros(0) if face is None else array(face.outward)
    jet = state.jet
    fields = (
        state.points,
        state.tension,
        jet.distance,
        jet.gradient,
        jet.hessian,
        jet.variance,
        jet.variance_gradient,
    )
    new = [x.clone(memory_format=torch.contiguous_format) for x in fields]
    walls = tuple(_thin_plate(wall) for wall in shape.walls)
    if len(walls) == 1:
        walls += ((np.empty((3, 0)), np.empty(0), np.empty((3, 0)), 1.0),)
    _descend(numbers, walls, array(pairs, torch.int64), array(signs), up, *(x.numpy() for x in new))
    return descent.State(new[0], new[1], SurfaceJet(*new[2:]))


def _thin_plate(wall: ShapeGP) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return the arrays of one surface that `sum_thin_plate` takes."""
    y, a, b, psi = wall.weighted.arrays
    return y, a[0], b[0], psi
