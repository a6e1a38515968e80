"""The frame-invariant code of three contacts, the input of a hand's learned model (Eq. 18)."""

import itertools

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.checks import check_tensor, checked
from torchgrasp.errors import BadArgument, Status
from torchgrasp.geometry.frames import degenerate, virtual_frame
from torchgrasp.values import ContactCode, Contacts

PERMUTATIONS: tuple[tuple[int, int, int], ...] = tuple(itertools.permutations(range(3)))  # pyright: ignore[reportAssignmentType]
"""The six assignments of three contacts to three fingers: finger i touches contact `PERMUTATIONS[k][i]`."""
CODE_NAMES = ("L1", "L2", "L3", "N1", "N2", "N3")
"""The numbers of a code q = (L, N): three lengths [m], three cosines."""


def encode_fingertips(points: Float[Tensor, "*b f 3"], normals: Float[Tensor, "*b f 3"]) -> Float[Tensor, "*b q"]:
    """Return the code q = (L, N) of points with unit normals, Eq. (18): six numbers of three points, as in the paper.

    L_i is the distance [m] of point i from the centre of the points; N is n1.n2, n1.n3, n2.n3 and so on. Rigid
    motion does not change the code. Negated normals do not change it either, so fingertips have the code of the
    contacts that they touch. Nor do a mirror image or a rotation of the normals alone: every match has to be checked
    afterwards.

    >>> encode_fingertips(torch.eye(3), torch.eye(3))[3:]
    tensor([0., 0., 0.])
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
