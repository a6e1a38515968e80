"""The frame-invariant code of three contacts (Eq. 18), and whether a model's codes are those of a hand."""

import itertools

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.checks import check_tensor, checked
from torchgrasp.errors import BadArgument, Status
from torchgrasp.geometry.frames import degenerate, virtual_frame
from torchgrasp.hand.hand import Hand
from torchgrasp.values import ContactCode, Contacts

PERMUTATIONS: tuple[tuple[int, int, int], ...] = tuple(itertools.permutations(range(3)))  # pyright: ignore[reportAssignmentType]
"""The six assignments of three contacts to three fingers: finger i touches contact `PERMUTATIONS[k][i]`."""
CODE_NAMES = ("L1", "L2", "L3", "N1", "N2", "N3")  # the numbers of a code q = (L, N): three lengths [m], three cosines


def encode_fingertips(points: Float[Tensor, "*b f 3"], normals: Float[Tensor, "*b f 3"]) -> Float[Tensor, "*b q"]:
    """Return the code q = (L, N) of points with unit normals, Eq. (18): six numbers of three points, as in the paper.

    L_i is the distance [m] of point i from the centre of the points; N is n1.n2, n1.n3, n2.n3 and so on. Rigid
    motion does not change the code. Negated normals do not change it either, so fingertips have the code of the
    contacts that they touch. Nor do a mirror image or a rotation of the normals alone: every match has to be checked
    afterwards.
    """
    lengths = torch.linalg.vector_norm(points - points.mean(-2, keepdim=True), dim=-1)
    cosines = torch.stack([(n * m).sum(-1) for n, m in itertools.combinations(normals.unbind(-2), 2)], dim=-1)
    return torch.cat([lengths, cosines], dim=-1)


@checked
def encode(contacts: Contacts | tuple[Tensor, Tensor]) -> ContactCode:
    """Encode contact triples for all six assignments of contacts to fingers, Eqs. (15)-(18).

    Points [m] and unit normals are (b, 3, 3). A triple without a virtual frame holds NaN and `Status.DEGENERATE`.

    Raises:
        BadArgument: wrong shapes, non-finite numbers, or normals whose length is not 1 within 1e-3.

    >>> encode((torch.eye(3)[None], torch.eye(3)[None])).q.shape
    torch.Size([1, 6, 6])
    """
    points, normals = (contacts.points, contacts.normals) if isinstance(contacts, Contacts) else contacts
    check_tensor("points", points, (None, 3, 3))
    check_tensor("normals", normals, (len(points), 3, 3))
    lengths = torch.linalg.vector_norm(normals, dim=-1)
    if bool(((lengths - 1).abs() > 1e-3).any()):
        worst = lengths.flatten()[(lengths - 1).abs().argmax()].item()
        raise BadArgument("normals", f"a normal of length {worst:.6g}", "unit vectors")
    order = torch.tensor(PERMUTATIONS, device=points.device)
    ordered_points, ordered_normals = points[:, order], normals[:, order]  # (b, 6, 3, 3)
    flat = degenerate(ordered_points).any(1)  # in any order: at the threshold rounding may distinguish them
    bad = flat[:, None, None]
    # A degenerate row gets another triangle, so that one call frames all rows.
    frames = virtual_frame(torch.where(bad[..., None], torch.eye(3).to(points), ordered_points))
    return ContactCode(
        q=torch.where(bad, torch.nan, encode_fingertips(ordered_points, ordered_normals)),
        obj_from_vf=torch.where(bad[..., None], torch.nan, frames),
        status=torch.where(flat, int(Status.DEGENERATE), int(Status.OK)),
        permutation=order,
    )


CODE_TOLERANCE = 1e-5
"""Largest difference of two codes [m or cosine] by rounding: `describe_compatibility` writes seven digits."""


def describe_compatibility(hand: Hand) -> dict[str, str]:
    """Return the metadata of samples and models about their hand: name, fingers, hash of its files, some codes."""
    codes = " ".join(f"{x:.7f}" for x in _probe_codes(hand).flatten().tolist())
    return {"hand": hand.name, "fingers": hand.source.option, "hand_sha256": hand.source.sha256, "hand_codes": codes}


def check_compatible(meta: dict[str, str], joint_names: tuple[str, ...], hand: Hand) -> None:
    """Refuse a model of another hand, fingers, limits or fingertips; without `hand_codes`, of other joint names."""
    if joint_names != hand.joint_names:
        raise BadArgument("mixture", f"joints {joint_names}", f"the joints {hand.joint_names} of the hand")
    if "hand_codes" not in meta:
        return
    ours = _probe_codes(hand).flatten()
    try:
        theirs = torch.tensor([float(x) for x in meta["hand_codes"].split()], dtype=torch.float64)
    except ValueError as error:
        raise BadArgument("mixture", f"hand_codes {meta['hand_codes']!r}", "numbers") from error
    if theirs.shape != ours.shape or not torch.allclose(theirs.to(ours), ours, rtol=0, atol=CODE_TOLERANCE):
        whose = f"hand {meta.get('hand')!r}, fingers {meta.get('fingers')!r}, of other limits or fingertips"
        allowed = f"one of {hand.name!r}, {hand.source.option!r}: train it anew"
        raise BadArgument("mixture", f"a model of {whose}", allowed)


def _probe_codes(hand: Hand) -> Float[Tensor, "3 q"]:
    """Return the codes of three postures between the limits; they depend on limits, links and fingertips."""
    lower, upper = hand.lower.double(), hand.upper.double()
    share = torch.tensor([0.2, 0.5, 0.7], dtype=torch.float64, device=lower.device)
    index = (torch.arange(hand.dof)[None] + torch.arange(3)[:, None]) % 3
    return encode_fingertips(*hand.fingertips(lower + share[index] * (upper - lower)))
