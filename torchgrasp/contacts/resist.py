"""The greatest multiple of a task's wrench that contacts resist, with a proof by linear programming
duality.

A contact pushes with at most its strength b_i along the edges of its friction cone. K holds the
wrenches of all such forces; -t is the wrench that balances the load t. The greatest s with -s t in
K is the least value of

    sum_i b_i max(0, max_k y.w_ik)    among the twists y with y.t = -1,

so each such y proves that s is no greater. The simplex method maximises -t.y, whose greatest value
is 1/s, with z_i >= b_i y.w_ik, z_i >= 0 and sum_i z_i <= 1. It begins at y = 0, z_i = 1/(2f).
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.contacts.form_closure import (
    BALANCED,
    GRASPS_PER_CHUNK,
    Vectors,
    centre_and_radius,
    maximise,
    wrenches,
)
from torchgrasp.foundation.base import row_numbers
from torchgrasp.geometry.linalg import dot
from torchgrasp.values.planning import Contacts
from torchgrasp.values.specs import ContactSpec


class Resisted(NamedTuple):
    """The greatest multiple of the worst load that each of b contact sets resists.

    All vectors are in the frame of the contacts. `twist` proves that no greater multiple is
    possible.

    Args:
        margin: the greatest multiple s (no unit) of the load that the contacts resist; 0 if it is
            not proven.
        load: the worst load t, a force [N] and a torque [N m] about the contacts' centroid.
        twist: the proof, a motion y [1/N, 1/(N m)] about the centroid with y . t = -1. Along it,
            admissible contact forces do at most the work s. To resist m t, they must do the work m.
        forces: contact forces [N] (b, f, 3) that balance s t.
    """

    margin: Float[Tensor, "b"]
    load: Float[Tensor, "b 6"]
    twist: Float[Tensor, "b 6"]
    forces: Vectors


def resist_loads(
    points: Vectors,
    normals: Vectors,
    strength: Float[Tensor, "b f"],
    loads: Float[Tensor, "b w 6"],
    spec: ContactSpec,
) -> Resisted:
    """Return the greatest multiple of the worst of w loads that each of b contact sets resists.

    The worst load is the one with the least such multiple. The contact forces are within the
    friction cones, and no finger exceeds its `strength`.

    Args:
        points: contacts (b, f, 3) [m].
        normals: outward unit normals (b, f, 3) of the object, in the same frame.
        strength: greatest normal force [N] of each contact.
        loads: w loads of each set: force [N], then torque [N m] about the origin of the points'
            frame.
        spec: its `planned_friction` and `edges` define the friction cones.
    """
    count = loads.shape[1]
    centre, radius = centre_and_radius(points)
    force, torque = loads.split(3, -1)
    torque = torque - torch.linalg.cross(centre.expand_as(force), force)
    about = torch.cat([force, torque], -1)
    # of wrenches in Eq. (13): (b, 1, 6)
    unit = torch.cat([torch.ones_like(radius), radius], 1).repeat_interleave(3, 1).mT
    edge = wrenches(points, normals, spec.planned_friction, spec.edges)
    edge = strength[..., None, None] * edge
    edge = torch.cat([edge, torch.zeros_like(edge[:, :, :1])], 2)  # the last is no push
    goal = (-about / unit).flatten(0, 1)
    rows = row_numbers(goal).split(GRASPS_PER_CHUNK)
    found = [_solve(edge[row // count], goal[row]) for row in rows]
    margin, twist, forces = map(torch.cat, zip(*found, strict=True))
    worst = margin.view(-1, count).argmin(1)
    row = torch.arange(len(points), device=worst.device) * count + worst
    return Resisted(margin[row], about.flatten(0, 1)[row], twist[row] / unit[:, 0], forces[row])


def share_carried(
    contacts: Contacts,
    strength: Float[Tensor, "b f"],
    load: Float[Tensor, "b 6"],
    spec: ContactSpec,
) -> Float[Tensor, "b"]:
    """Return the share (b,) of a load that each of b contact sets can balance, at most 1.

    Arguments and limits are those of `multiple_carried`.
    """
    return multiple_carried(contacts, strength, load, spec).clamp(max=1)


def multiple_carried(
    contacts: Contacts,
    strength: Float[Tensor, "b f"],
    load: Float[Tensor, "b 6"],
    spec: ContactSpec,
) -> Float[Tensor, "b"]:
    """Return the greatest multiple (b,) of a load that each of b contact sets can balance.

    The contact forces are within the friction cones, and no finger exceeds its `strength`. The
    multiple is 0 where none is proven.

    Args:
        contacts: b sets of f contacts [m] with outward unit normals.
        strength: greatest normal force [N] of each contact.
        load: force [N], then torque [N m] about the centroid of the contacts.
        spec: its `planned_friction` and `edges` define the friction cones.
    """
    arms = contacts.points - contacts.points.mean(1, keepdim=True)
    return resist_loads(arms, contacts.normals, strength, load[:, None], spec).margin


def _solve(
    edge: Float[Tensor, "r f e 6"], goal: Float[Tensor, "r 6"]
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the greatest multiple of each wrench `goal` that forces along the edges make, a twist,
    and the forces.

    Their shapes are (r,), (r, 6) and (r, f, 3). `edge` holds for each of f contacts the wrenches of
    its greatest forces along e edges.
    """
    r, f, e, _ = edge.shape
    own = torch.eye(f).to(edge)  # the unknowns are y and u_i = 2f z_i - 1
    above = torch.cat([2 * f * edge, -own[:, None].expand(r, f, e, f)], -1).flatten(1, 2)
    total = torch.cat([edge.new_zeros(6), edge.new_full((f,), 1 / f)]).expand(r, 1, -1)
    objective = torch.cat([goal, goal.new_zeros(r, f)], 1)
    found, tight, weight = maximise(objective, torch.cat([above, total], 1))
    share = goal.new_zeros(r, f * e + 1).scatter_add(1, tight, weight)
    share = share[:, :-1].view(r, f, e, 1)
    made = (2 * f * share * edge).sum(2)
    gauge = weight.sum(1)
    y = found[:, :6]
    exact = (made.sum(1) - goal).abs().amax(1) <= BALANCED
    exact &= (weight.amin(1) >= -BALANCED) & (gauge > 0)
    margin = torch.where(exact, 1 / gauge, 0.0)
    twist = y / dot(goal, y, keepdim=True)
    return margin, twist, made[..., :3] * margin[:, None, None]
