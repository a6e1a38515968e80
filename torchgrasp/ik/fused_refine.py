"""The refinement of hand configurations (`torchgrasp.ik.refine`) as one compiled loop over hands,
and the clearance on their paths (`torchgrasp.ik.motion`) as another.

The first computes residuals and Jacobian of `grasp_residuals`, and the steps of
`levenberg_marquardt` with `LeastSquares`. They take float64 on the CPU, and a world of one object
whose table has no edge. Vectors are tuples of three numbers, or rows of arrays. l counts links, m
residuals, d the numbers of a step.
"""

import collections
import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.fused import array, compiled, inlined
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
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.self_collision import LEAST_SQUARE, PARALLEL_EDGES
from torchgrasp.ik.clearance import CLEARANCE, HINGES, MILLIMETRE, SELF_CLEARANCE, CollisionWorld
from torchgrasp.ik.configuration import Configuration

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


class WorldPart(NamedTuple):
    """A grid of distances, or a plane, or nothing, as `kind` 2, 1 and 0 says; and numbers that are
    added to the distance of each sphere's centre to give its clearance.
    """

    kind: int
    values: np.ndarray
    origin: np.ndarray  # of a plane its normal
    shape: np.ndarray
    spacing: float  # of a plane its offset
    grown: np.ndarray


@inlined
def turn(frame, v):
    """Return a direction in the frame in which the columns of a pose, the rows of `frame`, are."""
    turned = scale(frame[0], v[0])
    return add(add(turned, frame[1], v[1]), frame[2], v[2])


@inlined
def place(frame, v):
    """Return a point in that frame."""
    return add(turn(frame, v), frame[3], 1.0)


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
    """Return separation, push and contact point of two boxes, as `SelfCollision.pushes`; the point
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
def _cell(part, p, axis):
    """Return the coordinate of a point in a grid [nodes]."""
    return (p[axis] - part.origin[axis]) / part.spacing


@inlined
def _inside(part, at, axis):
    """Return the nearest coordinate inside the grid; 0 for NaN, which would be no index."""
    last = part.shape[axis] - 1.0
    at = at if at > 0.0 else 0.0
    return at if at < last else last


@inlined
def _coarse(part, p):
    """Return the height over a plane, or the distance at the nearest node of a grid."""
    if part.kind == 1:
        return dot(p, part.origin) - part.spacing
    number = 0
    for axis in range(3):
        node = _inside(part, np.rint(_cell(part, p, axis)), axis)
        number = number * part.shape[axis] + int(node)
    return part.values[number]


@inlined
def _lerp(a, b, share):
    """Return the number at a share of the way from a to b."""
    return a + share * (b - a)


@inlined
def _exact(part, p):
    """Return distance and gradient, as `DistanceField.query`."""
    x = _cell(part, p, 0)
    y = _cell(part, p, 1)
    z = _cell(part, p, 2)
    inside_x = _inside(part, x, 0)
    inside_y = _inside(part, y, 1)
    inside_z = _inside(part, z, 2)
    nx, ny, nz = part.shape
    i = min(int(inside_x), nx - 2)
    j = min(int(inside_y), ny - 2)
    k = min(int(inside_z), nz - 2)
    fx = inside_x - i
    fy = inside_y - j
    fz = inside_z - k
    at = (i * ny + j) * nz + k
    v = part.values
    low = v[at], v[at + nz], v[at + ny * nz], v[at + ny * nz + nz]
    at += 1
    high = v[at], v[at + nz], v[at + ny * nz], v[at + ny * nz + nz]
    p00 = _lerp(low[0], high[0], fz)
    p01 = _lerp(low[1], high[1], fz)
    p10 = _lerp(low[2], high[2], fz)
    p11 = _lerp(low[3], high[3], fz)
    back = _lerp(p00, p01, fy)
    front = _lerp(p10, p11, fy)
    up_back = _lerp(high[0] - low[0], high[1] - low[1], fy)
    up_front = _lerp(high[2] - low[2], high[3] - low[3], fy)
    slope = front - back, _lerp(p01 - p00, p11 - p10, fx), _lerp(up_back, up_front, fx)
    distance = _lerp(back, front, fx)
    h = part.spacing
    beyond = (x - inside_x) * h, (y - inside_y) * h, (z - inside_z) * h
    away = math.sqrt(dot(beyond, beyond))
    if away == 0.0:
        return distance, scale(slope, 1 / h)
    gx = slope[0] / h if beyond[0] == 0.0 else beyond[0] / away
    gy = slope[1] / h if beyond[1] == 0.0 else beyond[1] / away
    gz = slope[2] / h if beyond[2] == 0.0 else beyond[2] / away
    return distance + away, (gx, gy, gz)


@inlined
def _clear(h, n, part, spheres, twists, order, index, residual, jacobian):
    """Write the rows of the spheres that are nearest to a part of the world, as `sphere_rows`."""
    order[:] = math.inf
    last = 0
    for s in range(len(spheres)):
        if part.grown[s] < math.inf:
            coarse = _coarse(part, spheres[s]) + part.grown[s]
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
            distance, slope = _exact(part, p)
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
        own = (target[g], normals[g], room)
        cost = _evaluate(h, parts, n, joints[g], poses[g], *own, residual[g], jacobian[g])
        damping = n.first
        for _ in range(n.steps):
            if cost < n.solved or damping == math.inf:
                break
            _step(n, damping, len(h.tip_link), residual[g], jacobian[g], matrix, x)
            _move(h, joints[g], poses[g], x, new_joints, new_pose)
            new = _evaluate(h, parts, n, new_joints, new_pose, *own, trial[0], trial[1])
            if new < cost:
                rests = new > (1 - n.stalled) * cost
                after = damping / n.fall
                cost = new
                copy(joints[g], new_joints)
                copy(poses[g], new_pose)
                copy(residual[g], trial[0])
                copy(jacobian[g], trial[1])
            else:
                rests = damping > n.lost
                after = damping * n.rise
            damping = math.inf if rests else min(max(after, n.least), n.most)


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
    """Return configurations after at most `steps` steps, and their residuals and Jacobian."""
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


def world_parts(
    radius: Float[Tensor, "s"], touching: Bool[Tensor, "s"], world: CollisionWorld
) -> tuple[WorldPart, ...]:
    """Return object, obstacles and table of a world, in this order; the spheres in the mask
    `touching` may touch object and table.
    """
    none = np.zeros(0)
    size = np.zeros(3, np.int64)
    parts = []
    for field in (world.field, world.obstacles and world.obstacles.field):
        if not isinstance(field, SignedDistanceField):
            parts.append(WorldPart(0, none, none, size, 0.0, none))
            continue
        spared = touching & (field is world.field)
        grown = array(torch.where(spared, math.inf, -radius))
        shape = np.array(field.values.shape)
        spacing = float(field.spacing)
        parts.append(WorldPart(2, array(field.nodes), array(field.origin), shape, spacing, grown))
    plane = world.plane
    if plane is None:
        return (*parts, WorldPart(0, none, none, size, 0.0, none))
    # contacts tell how low tips are; a bool times a number would be a float32
    grown = array(CLEARANCE * touching.to(radius) - radius)
    return (*parts, WorldPart(1, none, array(plane.normal), size, float(plane.offset), grown))


@compiled
def _sweep(parts, centres, direction, step, nodes, coarse, least):
    """Write the least clearance of each hand on its path, as `_clearance` of `motion`."""
    steps, spheres = coarse.shape
    for g in range(len(centres)):
        least[g] = math.inf
        for part in parts:
            if part.kind == 0:
                continue
            near = math.inf
            first = scale(centres[g, 0], 1.0)
            own = 0
            for k in range(steps):
                for s in range(spheres):
                    p = add(centres[g, s], direction[g], -step * (k + 1))
                    coarse[k, s] = _coarse(part, p) + part.grown[s]
                    if coarse[k, s] < near:
                        near = coarse[k, s]
                        first = p
                        own = s
            if nodes > 0.0 and part.kind == 2:
                near = _exact(part, first)[0] + part.grown[own]
                within = near + nodes * part.spacing
                for k in range(steps):
                    for s in range(spheres):
                        if coarse[k, s] < within:
                            p = add(centres[g, s], direction[g], -step * (k + 1))
                            near = min(near, _exact(part, p)[0] + part.grown[s])
            least[g] = min(least[g], near)


def sweep(
    centres: Float[Tensor, "g s 3"],
    radius: Float[Tensor, "s"],
    direction: Float[Tensor, "g 3"],
    world: CollisionWorld,
    steps: int,
    step: float,
    nodes: float,
) -> Float[Tensor, "g"]:
    """Return the least clearance [m] of hands at `steps` positions on their paths, each `step` [m]
    back from the one before.

    It is exact with `nodes`, the error in grid spacings of a clearance at the nearest node; with 0
    it is that at the nearest nodes.
    """
    parts = world_parts(radius, torch.zeros_like(radius, dtype=torch.bool), world)
    least = torch.empty_like(centres[:, 0, 0])
    coarse = np.empty((steps, len(radius)))
    _sweep(parts, array(centres), array(direction), step, nodes, coarse, least.numpy())
    return least
