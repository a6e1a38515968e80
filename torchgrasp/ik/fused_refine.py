"""The refinement of hand configurations (`torchgrasp.ik.refine`) as one compiled loop over hands.

It computes residuals and Jacobian of `grasp_residuals`, and the steps of `levenberg_marquardt` with
`LeastSquares`. It takes float64 on the CPU, and a world of one object whose table has no edge.
Vectors are tuples of three numbers, or rows of arrays.
"""

import collections
import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.fused import array, compiled, inlined
from torchgrasp.geometry.fused_grid import look_up
from torchgrasp.geometry.fused_vectors import (
    add,
    copy,
    cross,
    dot,
    factorise,
    put,
    scale,
    solve_factorised,
)
from torchgrasp.geometry.optim import LeastSquares
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.self_collision import LEAST_SQUARE, PARALLEL_EDGES
from torchgrasp.ik.clearance import CLEARANCE, HINGES, MILLIMETRE, SELF_CLEARANCE, CollisionWorld
from torchgrasp.ik.configuration import Configuration
from torchgrasp.ik.fused_world import coarse_clearance, place, turn, world_parts

INDEX = torch.int64


TABLES = (
    "coupling offset lower upper tables joint parent moves steps motion_link turning sliding "
    "sphere_link sphere_center tip_link tip_center tip_normal tip_cosine "
    "shape_link shape_axes shape_center shape_half shape_radius bounding pairs kinds pair_moves"
)
HandTables = collections.namedtuple("HandTables", TABLES.split())
"""Arrays of a hand, whose links are sorted by level, as in `KinematicTree.tables`.

Rows of `tables[k, t]` are the columns of table t of link k, rows of `shape_axes[s]` the axes of a
box. `steps` is `FreeMotion.coupling`, empty for the identity.
"""
NUMBERS = (
    "tip pad unit clearance between hinges parallel least_square steps free "
    "first solved largest floor fall rise least most lost stalled"
)
SolverNumbers = collections.namedtuple("SolverNumbers", NUMBERS.split())
"""Weights and bounds of residuals, and the numbers of `LeastSquares`; `free` is 6, or 0 if the pose
is fixed.
"""


@inlined
def _place_links(h, joints, pose, frames):
    """Write the columns of all link poses, as `KinematicTree.frames`."""
    for c in range(4):
        put(frames[0, c], pose[:3, c])
    for k in range(1, len(frames)):
        j = h.joint[k]
        q = h.offset[j]
        for a in range(len(joints)):
            q += h.coupling[j, a] * joints[a]
        constant, sine, cosine, slide = h.tables[k]
        for c in range(4):
            local = add(add(constant[c], sine[c], math.sin(q)), cosine[c], math.cos(q))
            local = add(local, slide[c], q)
            put(frames[k, c], turn(frames[h.parent[k]], local))
        put(frames[k, 3], add(frames[k, 3], frames[h.parent[k], 3], 1.0))


@inlined
def _differentiate(steps, twists, moves, force, torque, row):
    """Write the derivatives of a residual, as `SpatialJacobian.jacobian`."""
    for q in range(len(twists)):
        if moves[q] != 0.0:
            slope = moves[q] * (dot(force, twists[q, 0]) + dot(torque, twists[q, 1]))
            if len(steps):
                for d in range(len(row)):
                    row[d] += slope * steps[q, d]
            else:
                row[q] = slope


@inlined
def _reach(axes, half, direction):
    """Return how far a box reaches from its centre in a direction."""
    reach = 0.0
    for i in range(3):
        reach += half[i] * abs(dot(axes[i], direction))
    return reach


@inlined
def _corner(axes, half, direction, edge):
    """Return the corner of a box that is farthest in a direction, on an edge its middle."""
    corner = (0.0, 0.0, 0.0)
    for i in range(3):
        if i != edge:
            corner = add(corner, axes[i], np.sign(dot(axes[i], direction)) * half[i])
    return corner


@inlined
def _part_boxes(a, b, gap, half_a, half_b, apart, n):
    """Return separation, push and contact point of two boxes, as `SelfCollision.pushes`. The point
    is relative to the centre of box b.
    """
    best = -math.inf
    edge_a = edge_b = number = -1
    push = (0.0, 0.0, 0.0)
    for k in range(15):
        i = j = -1
        if k < 3:
            axis = scale(a[k], 1.0)
        elif k < 6:
            axis = scale(b[k - 3], 1.0)
        else:
            i = (k - 6) // 3
            j = (k - 6) % 3
            axis = cross(a[i], b[j])
            square = dot(axis, axis)
            if square <= n.parallel:
                continue
            axis = scale(axis, 1 / math.sqrt(square))
        along = abs(dot(axis, gap)) - _reach(a, half_a, axis) - _reach(b, half_b, axis)
        if along > best:
            best = along
            push = axis
            number = k
            edge_a = i
            edge_b = j
    if apart > best:
        return apart, scale(gap, 1 / math.sqrt(dot(gap, gap))), (0.0, 0.0, 0.0)
    if best >= n.between:
        return best, push, push
    if dot(push, gap) < 0:
        push = scale(push, -1.0)
    of_a = _corner(a, half_a, push, edge_a)
    of_b = scale(_corner(b, half_b, push, edge_b), -1.0)
    if number < 3:
        return best, push, of_b
    if number < 6:
        return best, push, add(of_a, gap, -1.0)
    between = add(add(gap, of_b, 1.0), of_a, -1.0)
    cosine = dot(a[edge_a], b[edge_b])
    beyond = dot(between, b[edge_b]) - cosine * dot(between, a[edge_a])
    return best, push, add(of_b, b[edge_b], -beyond / (1 - cosine * cosine))


@inlined
def _part_ball(axes, gap, half, radius, n):
    """Return separation and push of a sphere and a box, which is `gap` away from it."""
    push = (0.0, 0.0, 0.0)
    face = push
    inside = -math.inf
    for i in range(3):
        local = dot(axes[i], gap)
        out = abs(local) - half[i]
        sign = -1.0 if local < 0 else 1.0
        if out > 0:
            push = add(push, axes[i], sign * out)
        if out > inside:
            inside = out
            face = scale(axes[i], sign)
    if inside <= 0:
        return inside - radius, face
    length = math.sqrt(dot(push, push))
    return length - radius, scale(push, 1 / max(length, math.sqrt(n.least_square)))


@inlined
def _part_links(h, n, frames, twists, axes, centers, residual, jacobian):
    """Write the rows of the pairs of links that are nearest, as `clearance_rows`."""
    for s in range(len(centers)):
        frame = frames[h.shape_link[s]]
        put(centers[s], place(frame, h.shape_center[s]))
        for i in range(3):
            put(axes[s, i], turn(frame, h.shape_axes[s, i]))
    used = 0
    for p in range(len(h.pairs)):
        a, b = h.pairs[p]
        gap = add(centers[b], centers[a], -1.0)
        length = math.sqrt(max(dot(gap, gap), n.least_square))
        apart = length - h.bounding[a] - h.bounding[b]
        if apart >= n.between:
            continue
        if p < h.kinds[0]:
            found = _part_boxes(axes[a], axes[b], gap, h.shape_half[a], h.shape_half[b], apart, n)
            separation, push, arm = found
            at = add(centers[b], arm, 1.0)
        elif p < h.kinds[0] + h.kinds[1]:
            separation, push = _part_ball(axes[b], gap, h.shape_half[b], h.shape_radius[a], n)
            at = scale(centers[a], 1.0)
        else:
            separation = apart
            push = scale(gap, 1 / length)
            at = scale(centers[b], 1.0)
        lack = (n.between - separation) * n.unit
        k = used
        if used == len(residual):  # more than enough: the greatest count
            k = np.argmin(residual)
        if lack <= 0 or (used == len(residual) and lack <= residual[k]):
            continue
        used = min(used + 1, len(residual))
        residual[k] = lack
        jacobian[k] = 0.0
        force = scale(push, -n.unit)
        _differentiate(h.steps, twists, h.pair_moves[p], force, cross(at, force), jacobian[k])


@inlined
def _clear(h, n, part, spheres, twists, order, index, residual, jacobian):
    """Write the rows of the spheres that are nearest to a part of the world, as `sphere_rows`."""
    order[:] = math.inf
    last = 0
    for s in range(len(spheres)):
        if part.grown[s] < math.inf:
            coarse = coarse_clearance(part, spheres[s]) + part.grown[s]
            if coarse < order[last]:
                order[last] = coarse
                index[last] = s
                last = np.argmax(order)
    for k in range(len(order)):
        if order[k] == math.inf:
            continue
        p = spheres[index[k]]
        clearance = order[k]
        slope = (part.origin[0], part.origin[1], part.origin[2])
        if part.kind == 2:
            distance, slope = look_up(part, p)
            clearance = distance + part.grown[index[k]]
        if clearance < n.clearance:
            residual[k] = (n.clearance - clearance) * n.unit
            force = scale(slope, -n.unit)
            moves = h.moves[h.sphere_link[index[k]]]
            _differentiate(h.steps, twists, moves, force, cross(p, force), jacobian[k])


@inlined
def _evaluate(h, parts, n, joints, pose, target, normals, room, residual, jacobian):
    """Write the residuals of a hand and their Jacobian, as `grasp_residuals`; return their cost."""
    frames, spheres, twists, axes, centers, order, index = room
    residual[:] = 0.0
    jacobian[:] = 0.0
    _place_links(h, joints, pose, frames)
    for q in range(len(twists)):
        frame = frames[h.motion_link[q]]
        turning = turn(frame, h.turning[q])
        put(twists[q, 1], turning)
        sliding = turn(frame, h.sliding[q])
        put(twists[q, 0], add(cross(frame[3], turning), sliding, 1.0))
    tips = len(h.tip_link)
    for f in range(tips):
        frame = frames[h.tip_link[f]]
        moves = h.moves[h.tip_link[f]]
        center = place(frame, h.tip_center[f])
        pad = turn(frame, h.tip_normal[f])
        for k in range(3):
            row = 3 * f + k
            residual[row] = n.tip * (center[k] - target[f, k])
            force = (n.tip * (k == 0), n.tip * (k == 1), n.tip * (k == 2))
            _differentiate(h.steps, twists, moves, force, cross(center, force), jacobian[row])
        outside = h.tip_cosine[f] + dot(pad, normals[f])
        if outside > 0:
            row = 3 * tips + f
            residual[row] = n.pad * outside
            torque = scale(cross(pad, normals[f]), n.pad)
            _differentiate(h.steps, twists, moves, (0.0, 0.0, 0.0), torque, jacobian[row])
    first = 4 * tips
    last = first + min(n.hinges, len(h.pairs))
    _part_links(h, n, frames, twists, axes, centers, residual[first:last], jacobian[first:last])
    for s in range(len(spheres)):
        put(spheres[s], place(frames[h.sphere_link[s]], h.sphere_center[s]))
    for part in parts:
        if part.kind:
            first = last
            last = first + len(order)
            own = residual[first:last], jacobian[first:last]
            _clear(h, n, part, spheres, twists, order, index, own[0], own[1])
    return _cost(residual)


@inlined
def _cost(residual):
    """Return the sum of squared residuals."""
    total = 0.0
    for x in residual:
        total += x * x
    return total


@inlined
def _step(n, damping, tips, residual, jacobian, matrix, x):
    """Write the damped step, as `LeastSquares.step`; it is zero where the matrix is singular."""
    d = len(x)
    matrix[:] = 0.0
    x[:] = 0.0
    fixed = jacobian.shape[1] - d
    for k in range(len(residual)):
        # a bound that holds has no row, but a tip that is in its place has
        if k < 3 * tips or residual[k] != 0.0:
            row = jacobian[k, fixed:]
            for i in range(d):
                if row[i] != 0.0:
                    x[i] -= row[i] * residual[k]
                    for j in range(i + 1):
                        matrix[i, j] += row[i] * row[j]
    for i in range(d):
        matrix[i, i] += damping * matrix[i, i] + n.floor
    if not factorise(matrix):
        x[:] = 0.0
        return
    solve_factorised(matrix, x)
    most = n.largest
    for change in x:
        most = max(most, abs(change))
    x *= n.largest / most


@inlined
def _move(h, joints, pose, x, new_joints, new_pose):
    """Write the configuration after a step, as `Configuration.integrate`."""
    free = len(x) - len(joints)
    for a in range(len(joints)):
        new_joints[a] = min(max(joints[a] + x[free + a], h.lower[a]), h.upper[a])
    copy(new_pose, pose)
    if not free:
        return
    vector = (x[3], x[4], x[5])
    angle = math.sqrt(dot(vector, vector))
    first = second = 1.0
    if angle > 0:
        first = math.sin(angle) / angle
        second = math.sin(angle / 2) / (angle / 2)
    for r in range(3):
        new_pose[r, 3] += dot(pose[r], x)
        # a row times the exponential map of the vector
        once = cross(pose[r], vector)
        twice = cross(once, vector)
        row = add(add(pose[r], once, first), twice, second * second / 2)
        put(new_pose[r], row)


@compiled
def _solve(h, parts, n, joints, poses, target, normals, residual, jacobian):
    """Refine configurations in place, as `levenberg_marquardt` with `LeastSquares`, and write their
    residuals and Jacobians.
    """
    links = len(h.joint)
    d = jacobian.shape[2]
    free = d - 6 + n.free
    trial = np.empty(residual.shape[1]), np.empty(jacobian.shape[1:])
    new_joints = np.empty(joints.shape[1])
    new_pose = np.empty((4, 4))
    matrix = np.empty((free, free))
    x = np.empty(free)
    hinges = min(n.hinges, len(h.sphere_link))
    shapes = len(h.shape_link)
    room = (
        np.empty((links, 4, 3)),
        np.empty((len(h.sphere_link), 3)),
        np.empty((len(h.motion_link), 2, 3)),
        np.empty((shapes, 3, 3)),
        np.empty((shapes, 3)),
        np.empty(hinges),
        np.zeros(hinges, np.int64),
    )
    for g in range(len(joints)):
        copy(new_joints, joints[g])
        copy(new_pose, poses[g])
        cost = math.inf
        damping = n.first
        for k in range(n.steps + 1):
            # the only call, at the start and after each step: each would be compiled in full
            own = (new_joints, new_pose, target[g], normals[g], room, trial[0], trial[1])
            new = _evaluate(h, parts, n, *own)
            if k == 0 or new < cost:
                rests = k > 0 and new > (1 - n.stalled) * cost
                after = damping / n.fall
                cost = new
                copy(joints[g], new_joints)
                copy(poses[g], new_pose)
                copy(residual[g], trial[0])
                copy(jacobian[g], trial[1])
            else:
                rests = damping > n.lost
                after = damping * n.rise
            if k > 0:
                damping = math.inf if rests else min(max(after, n.least), n.most)
            if k == n.steps or cost < n.solved or damping == math.inf:
                break
            _step(n, damping, len(h.tip_link), residual[g], jacobian[g], matrix, x)
            _move(h, joints[g], poses[g], x, new_joints, new_pose)


def solve(
    hand: Hand,
    configuration: Configuration,
    target: Float[Tensor, "g f 3"],
    normals: Float[Tensor, "g f 3"],
    world: CollisionWorld,
    tips_touch: bool,
    weights: tuple[float, float],
    problem: LeastSquares | None = None,
    steps: int = 0,
    fixed: bool = False,
) -> tuple[Configuration, Tensor, Tensor]:
    """Return configurations after at most `steps` Levenberg-Marquardt steps. Return then their
    weighted residuals (g, k) and Jacobian (g, k, 6 + h).

    Args:
        hand: the hand, with h actuated joints.
        configuration: the g configurations at the start.
        target: wanted fingertip centres (g, f, 3) [m] in the object's frame.
        normals: outward unit normals (g, f, 3) at the contacts, in the same frame.
        world: what the links must keep clear of.
        tips_touch: whether fingertips may touch the object and the table.
        weights: weights (no unit) of the errors of tip positions [mm] and of pad directions.
        problem: the parameters of the solver; None means those of `LeastSquares`.
        steps: greatest number of steps; with 0 the start is only evaluated.
        fixed: whether the hand's pose stays as it is.
    """
    tables = hand.derived.get(HandTables) or hand.derived.setdefault(HandTables, _tables(hand))
    spheres = hand.collision_spheres
    parts = world_parts(spheres.radius, spheres.touching & tips_touch, world)
    count = sum(part.kind > 0 for part in parts)
    hinges = [min(HINGES, len(tables.pairs)), *[min(HINGES, len(tables.sphere_link))] * count]
    rows = 4 * len(hand.tips) + sum(hinges)
    g = len(target)
    joints = configuration.joints.clone(memory_format=torch.contiguous_format)
    poses = configuration.obj_from_hand.clone(memory_format=torch.contiguous_format)
    residual = target.new_empty(g, rows)
    jacobian = target.new_empty(g, rows, 6 + hand.dof)
    names = SolverNumbers._fields[SolverNumbers._fields.index("solved") :]
    solver = [getattr(problem or LeastSquares, name) for name in ("first_damping", *names)]
    numbers = SolverNumbers(
        weights[0] / MILLIMETRE,
        weights[1],
        1 / MILLIMETRE,
        CLEARANCE,
        SELF_CLEARANCE,
        HINGES,
        PARALLEL_EDGES,
        LEAST_SQUARE,
        steps,
        0 if fixed else 6,
        *map(float, solver),
    )
    given = joints.numpy(), poses.numpy(), array(target), array(normals)
    _solve(tables, parts, numbers, *given, residual.numpy(), jacobian.numpy())
    return Configuration(joints, poses), residual, jacobian


def _tables(hand: Hand) -> HandTables:
    """Return the arrays of a hand."""
    tree = hand.tree
    motion = hand.motion
    spheres = hand.collision_spheres
    shapes = hand.self_collision
    tips = hand.tips
    place = tree.places
    sizes = torch.tensor(tree.level_sizes)
    above = (sizes.cumsum(0) - sizes).roll(1)  # the first link of the level above
    parent = tree.parent + above.repeat_interleave(sizes)
    moves = torch.empty_like(motion.moves).index_copy(0, place, motion.moves)
    _, _, _, origins, turning, sliding = motion.product.unflatten(1, (4, -1)).split(motion.sizes)
    link = origins[:, 3].argmax(1)
    q = torch.arange(len(link))
    first, second = motion.moves[shapes.link[shapes.pairs]].unbind(1)
    return HandTables(
        *map(array, (hand.actuated.coupling, hand.actuated.offset, hand.lower, hand.upper)),
        array(tree.tables[..., 0].permute(3, 0, 2, 1)),
        array(tree.joint, INDEX),
        array(parent, INDEX),
        array(moves),
        np.zeros((0, 0)) if motion.coupling is None else array(motion.coupling),
        array(place[link], INDEX),
        array(turning[q, :3, link]),
        array(sliding[q, :3, link]),
        array(place[spheres.link_index], INDEX),
        array(spheres.center),
        array(place[tips.index], INDEX),
        array(tips.center),
        array(tips.normal),
        array(tips.cone.cos()),
        array(place[shapes.link], INDEX),
        array(shapes.rotation.permute(2, 1, 0)),
        *map(array, (shapes.center, shapes.half, shapes.radius, shapes._bounding)),
        array(shapes.pairs, INDEX),
        np.array(shapes.kinds),
        array(second - first),
    )
