"""From planned contacts to postures of the hand that may touch them (Eqs. 21-24)."""

import dataclasses

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.base import join
from torchgrasp.errors import BadArgument
from torchgrasp.frames import apply, degenerate, inverse, rotate, virtual_frame
from torchgrasp.hand.hand import Hand
from torchgrasp.posture_model.compatibility import check_compatible
from torchgrasp.posture_model.encoding import encode
from torchgrasp.posture_model.mixture import DEFAULT_ENERGY, GraspMixture
from torchgrasp.values import Contacts, IKSeeds

WRONG_SIDE = 0.3
"""A fingertip whose outward normal has a cosine above this with the object's touches it from inside. Codes do not
know the side (`encode_fingertips`), so that such guesses occur; they are ranked last."""

LENGTH_SLACK, COSINE_SLACK = 0.01, 0.5
"""Noise of a planned code against that of the pads' middles, in L [m] and N: what a rolling tip makes up for. Of
certified triples on a can, the Barrett hand's share within reach rises from 1 to 99 %, and most then refine."""


ROWS = 256
"""Contact triples answered in one pass: their postures stay in the cache."""


def query_mixture(
    contacts: Contacts, hand: Hand, mixture: GraspMixture, n_seeds: int = 8, max_energy: float = DEFAULT_ENERGY
) -> IKSeeds:
    """Ask the learned model for postures that touch the contacts, in all six assignments (Eqs. 21-24).

    The tips may roll, so that codes are taken as observed with noise (`LENGTH_SLACK`, `COSINE_SLACK`).
    For every assignment within reach (Eq. 21) the joints are guessed by their conditional mean (Eq. 23) and by the
    means of the most responsible components. A Gaussian knows no joint limits: a guess outside them is projected
    onto them, which is part of the model. The hand is placed by Eq. (24), the virtual frame of its fingertips on that
    of the contacts. Guesses keep the errors of the model, centimetres at the fingertips; refinement is another step.

    Args:
        contacts: contact triples on the object.
        hand: the hand.
        mixture: its model.
        guesses: postures for each assignment, at most one more than the mixture has components.
        max_energy: threshold on the least f_i of Eq. (21); `PAPER_ENERGY` is the paper's.

    Returns:
        The guesses, in the order of the contacts' rows; within a row those with the fingertips on the right side of
        the surface come first, each group by its largest tip error. A row without guesses is degenerate or out of
        reach.

    Raises:
        BadArgument: a mixture of another hand or of other limits or fingertips, a number outside its range, or
            malformed contacts.

    >>> from torchgrasp.hand.load import load_hand
    >>> from torchgrasp.posture_model.mixture import load_mixture
    >>> points = 0.05 * torch.eye(3)[None]
    >>> seeds = query_mixture(Contacts(points, 20 * points), load_hand("allegro"), load_mixture("allegro"))
    """
    check_compatible(mixture.meta, mixture.joint_names, hand)
    if not 1 <= n_seeds <= len(mixture.weights) + 1:
        raise BadArgument("n_seeds", n_seeds, f"1 to {len(mixture.weights) + 1}")
    if not max_energy > 0:
        raise BadArgument("max_energy", max_energy, "a positive number")
    loose = mixture.with_observation_noise(LENGTH_SLACK, COSINE_SLACK)
    firsts = range(0, max(len(contacts), 1), ROWS)
    parts = [_query(contacts[k : k + ROWS], hand, loose, n_seeds, max_energy) for k in firsts]
    rows = torch.cat([part.row + k for part, k in zip(parts, firsts, strict=True)])
    return dataclasses.replace(join(parts), row=rows)


def _query(contacts: Contacts, hand: Hand, mixture: GraspMixture, n_seeds: int, max_energy: float) -> IKSeeds:
    """Query the postures for some contact triples."""
    dtype = contacts.points.dtype
    code = encode((contacts.points.double(), contacts.normals.double()))
    reach = mixture.energy(code)
    row, assignment = torch.nonzero(reach < max_energy, as_tuple=True)  # NaN is not less
    order = code.permutation[assignment]  # (a, 3)
    joints = _guess_joints(mixture, code.q[row, assignment], n_seeds)
    joints = joints.clamp(hand.lower.to(joints), hand.upper.to(joints))

    # From here on one row a guess.
    row, order, reach, frame = (
        x.repeat_interleave(n_seeds, 0) for x in (row, order, reach[row, assignment], code.obj_from_vf[row, assignment])
    )
    joints = joints.flatten(0, 1)
    tips, tip_normals = hand.fingertips(joints)
    framed = ~degenerate(tips)
    joints, row, order, reach, frame = joints[framed], row[framed], order[framed], reach[framed], frame[framed]
    tips, tip_normals = tips[framed], tip_normals[framed]

    obj_from_hand = frame @ inverse(virtual_frame(tips))  # Eq. (24)
    wanted = contacts.points.double()[row[:, None], order]
    outward = contacts.normals.double()[row[:, None], order]
    tip_error = torch.linalg.vector_norm(apply(obj_from_hand, tips) - wanted, dim=-1)
    side = (rotate(obj_from_hand, tip_normals) * outward).sum(-1).mean(-1)
    rank = _rank(row, side > WRONG_SIDE, tip_error.amax(-1))
    found = IKSeeds(joints.to(dtype), obj_from_hand.to(dtype), row, order, reach.to(dtype), tip_error.to(dtype))
    return found[rank]


def _guess_joints(mixture: GraspMixture, q: Float[Tensor, "a 6"], n_seeds: int) -> Float[Tensor, "a k h"]:
    """Return the conditional mean of each code, then its most responsible components' means."""
    mean = mixture.joints(q)[:, None]
    if n_seeds == 1:
        return mean
    return torch.cat([mean, mixture.modes(q, n_seeds - 1)[0]], dim=1)


def _rank(row: Int[Tensor, "g"], wrong: Bool[Tensor, "g"], error: Float[Tensor, "g"]) -> Int[Tensor, "g"]:
    """Return the order by row, then side, then error; stable, so that equal guesses keep the model's order."""
    order = torch.argsort(error, stable=True)
    order = order[torch.argsort(wrong[order].long(), stable=True)]
    return order[torch.argsort(row[order], stable=True)]
