"""The ranking of `torchgrasp.ik.seeds.nearest_postures` as one compiled loop over contact sets.

A posture whose fingertips alone cost more than enough others is not placed.
"""

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.foundation.fused import array, compiled, inlined
from torchgrasp.geometry.fused_vectors import dot, insert, put
from torchgrasp.hand.collision_shapes import CollisionSpheres
from torchgrasp.ik.clearance import CLEARANCE, MILLIMETRE, CollisionWorld
from torchgrasp.ik.fused_world import place, turn, world_parts

BLOCK = 32  # numbers that are compared at a time, by vector instructions


@inlined
def _find_least(numbers, block, least, index):
    """Write the least of some numbers, ascending, and their indices."""
    least[:] = math.inf
    index[:] = 0
    for first in range(0, len(numbers), block):
        own = numbers[first : first + block]
        worst = least[-1]
        less = False
        for k in range(len(own)):
            less |= own[k] < worst
        if less:
            for k in range(len(own)):
                if own[k] < least[-1]:
                    insert(least, index, own[k], first + k)


@inlined
def _collide(part, frame, spheres, clearance, unit, cost, limit, node):
    """Return the cost of a placed hand plus that of `collision_cost` for a part of the world. A
    cost above the limit need not be exact.
    """
    x, y, z = spheres
    if part.kind == 0 or cost >= limit:
        return cost
    if part.kind == 1:
        a = dot(frame[0], part.origin)
        b = dot(frame[1], part.origin)
        c = dot(frame[2], part.origin)
        room = clearance + part.spacing - dot(frame[3], part.origin)
        for s in range(len(node)):
            lack = room - (a * x[s] + b * y[s] + c * z[s]) - part.grown[s]
            cost += (max(lack, 0.0) * unit) ** 2
        return cost
    node[:] = 0.0
    # the nodes come first, without a branch, so that vector instructions find them
    for axis in range(3):
        per = 1 / part.spacing
        a = frame[0, axis] * per
        b = frame[1, axis] * per
        c = frame[2, axis] * per
        first = (frame[3, axis] - part.origin[axis]) * per
        last = part.shape[axis] - 1.0
        for s in range(len(node)):
            at = np.rint(a * x[s] + b * y[s] + c * z[s] + first)
            at = at if at > 0.0 else 0.0
            node[s] = node[s] * part.shape[axis] + (at if at < last else last)
    for s in range(len(node)):
        if cost >= limit:
            break
        lack = clearance - part.values[int(node[s])] - part.grown[s]
        cost += (max(lack, 0.0) * unit) ** 2
    return cost


@compiled
def _rank(energy, obj_from_vf, vf_from_hand, spheres, parts, numbers, candidates, block, pairs):
    """Write the pairs of the least costs, as `rank_pairs`; `obj_from_vf` (r, a, 4, 3) holds columns
    of poses, `spheres` (s, 3, k) coordinates.
    """
    weight, unit, clearance = numbers
    least = np.empty(candidates, energy.dtype)
    index = np.empty(candidates, np.int64)
    costs = np.empty(pairs.shape[1])
    frame = np.empty((4, 3))
    node = np.empty(spheres.shape[2])
    for r in range(len(energy)):
        _find_least(energy[r], block, least, index)
        costs[:] = math.inf
        pairs[r] = index[: len(costs)]
        for c in range(candidates):
            cost = weight * least[c]
            if cost >= costs[-1]:
                break
            vf = obj_from_vf[r, index[c] // len(spheres)]
            sample = index[c] % len(spheres)
            for k in range(3):
                put(frame[k], turn(vf, vf_from_hand[sample, :3, k]))
            put(frame[3], place(vf, vf_from_hand[sample, :3, 3]))
            for part in parts:
                given = part, frame, spheres[sample], clearance, unit
                cost = _collide(*given, cost, costs[-1], node)
            if cost < costs[-1]:
                insert(costs, pairs[r], cost, index[c])


def rank_pairs(
    energy: Float[Tensor, "r p"],
    obj_from_vf: Float[Tensor, "r a 4 4"],
    vf_from_hand: Float[Tensor, "s 4 4"],
    centres: Float[Tensor, "s k 3"],
    spheres: CollisionSpheres,
    world: CollisionWorld,
    weight: float,
    candidates: int,
    count: int,
) -> Int[Tensor, "r count"]:
    """Return for each of r contact sets the indices (r, count) of its pairs of least cost, best
    first.

    A pair joins an assignment of contacts to fingers (a in number) and a posture (s in number).
    Pair i s + j is that of assignment i and posture j, so that p = a s. The cost [mm2] of a pair is
    `weight` times its energy, plus the `collision_cost` of the hand that is so placed.

    Args:
        energy: half the squared distance of the features of posture and contacts, without unit, for
            each of the p pairs.
        obj_from_vf: pose [m] of the virtual frame of the contacts in the object's frame, in each
            assignment.
        vf_from_hand: pose [m] of the hand in the virtual frame of each posture.
        centres: centres [m] of the k collision spheres in the hand's frame, in each posture.
        spheres: the collision spheres of the hand.
        world: what the hand must not touch, in the object's frame.
        weight: cost [mm2] of an energy of 1.
        candidates: number of pairs of each contact set, those of least energy, whose cost is
            computed.
        count: number of pairs that are returned.
    """
    pairs = torch.empty(len(energy), count, dtype=torch.int64)
    _rank(
        array(energy, torch.float32),
        array(obj_from_vf[..., :3, :].mT),
        array(vf_from_hand),
        array(centres.mT, torch.float32),
        world_parts(spheres.radius, spheres.touching, world)[::-1],  # the table refuses many
        (weight, 1 / MILLIMETRE, CLEARANCE),
        candidates,
        BLOCK,
        pairs.numpy(),
    )
    return pairs
