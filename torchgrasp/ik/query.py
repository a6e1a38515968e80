"""Seeds of the learned model for contacts (Eqs. 21-24)."""

import dataclasses

import torch

from torchgrasp.base import check_whole, join, settle
from torchgrasp.checks import Count, Positive, checked
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.frames import apply, degenerate, inverse, rotate, virtual_frame
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.ranking import lexical_order
from torchgrasp.posture_model.compatibility import check_compatible
from torchgrasp.posture_model.encoding import encode
from torchgrasp.posture_model.mixture import DEFAULT_ENERGY, GraspMixture
from torchgrasp.values import Contacts, IKSeeds

WRONG_SIDE = 0.3
"""Mean cosine of tips' and contacts' outward normals above which a seed touches from inside: codes have no side."""


@checked
def query_mixture(
    hand: Hand, contacts: Contacts, mixture: GraspMixture, n_seeds: Count = 8, max_energy: Positive = DEFAULT_ENERGY
) -> IKSeeds:
    """Return the learned model's configurations near the contacts, in all six assignments (Eqs. 21-24).

    For every assignment within reach (Eq. 21) the joints are the conditional mean (Eq. 23) and the means of the most
    responsible components, clamped to the limits. Eq. (24) places the hand. Fingertips are still off by centimetres.
    Seeds come in the order of the contacts' rows. Within a row the right side of the surface comes first, then the
    smaller tip error. An unreachable row has none.

    Args:
        contacts: triples on the object; hand and mixture follow them to their device.
        mixture: the hand's learned model.
        n_seeds: for each assignment, at most one more than the mixture has components.
        max_energy: threshold on the least f_i of Eq. (21); `PAPER_ENERGY` is the paper's.

    Raises:
        BadArgument: a mixture of another hand, limits or fingertips, a number out of range, or malformed contacts.

    >>> from torchgrasp.hand.load import load_hand
    >>> from torchgrasp.posture_model.mixture import load_mixture
    >>> points = 0.05 * torch.eye(3)[None]
    >>> seeds = query_mixture(load_hand("allegro"), Contacts(points, 20 * points), load_mixture("allegro"))
    """
    check_compatible(mixture.meta, mixture.joint_names, hand)
    check_whole("n_seeds", n_seeds, 1, len(mixture.weights) + 1)
    if not max_energy > 0:
        raise BadArgument("max_energy", max_energy, "a positive number")
    hand, mixture = settle(hand, contacts.points.device), settle(mixture, contacts.points.device)
    firsts = range(0, max(len(contacts), 1), 256)  # their configurations stay in the cache
    parts = [_query(hand, contacts[k : k + 256], mixture, n_seeds, max_energy) for k in firsts]
    rows = torch.cat([part.row + k for part, k in zip(parts, firsts, strict=True)])
    return dataclasses.replace(join(parts), row=rows)


def _query(hand: Hand, contacts: Contacts, mixture: GraspMixture, n_seeds: int, max_energy: float) -> IKSeeds:
    """Return the seeds of some triples."""
    code = encode((contacts.points.double(), contacts.normals.double()))
    energy = mixture.energy(code)
    row, assignment = torch.nonzero(energy < max_energy, as_tuple=True)  # NaN is not less
    q = code.q[row, assignment]
    joints = mixture.joints(q)[:, None]
    if n_seeds > 1:
        joints = torch.cat([joints, mixture.modes(q, n_seeds - 1)[0]], dim=1)
    joints = joints.clamp(hand.lower.to(joints), hand.upper.to(joints)).flatten(0, 1)
    # From here on one row a seed.
    row, assignment = row.repeat_interleave(n_seeds), assignment.repeat_interleave(n_seeds)
    tips, tip_normals = hand.fingertips(joints)
    framed = ~degenerate(tips)
    joints, row, assignment, tips, tip_normals = (x[framed] for x in (joints, row, assignment, tips, tip_normals))
    permutation = code.permutation[assignment]
    obj_from_hand = code.obj_from_vf[row, assignment] @ inverse(virtual_frame(tips))  # Eq. (24)
    points = contacts.points.double()[row[:, None], permutation]
    normals = contacts.normals.double()[row[:, None], permutation]
    tip_error = torch.linalg.vector_norm(apply(obj_from_hand, tips) - points, dim=-1)
    wrong_side = (rotate(obj_from_hand, tip_normals) * normals).sum(-1).mean(-1) > WRONG_SIDE
    order = lexical_order(row, wrong_side.int(), tip_error.amax(-1))
    seeds = IKSeeds(joints, obj_from_hand, row, permutation, energy[row, assignment], tip_error)
    return seeds[order].to(contacts.points.dtype)
