"""The code of three contacts against its definition and its symmetries."""

import itertools
import math

import pytest
import torch

from tests.make import near, real
from torchgrasp import Contacts
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.geometry.frames import apply, inverse, rotate, virtual_frame
from torchgrasp.geometry.linalg import unit
from torchgrasp.posture_model.mixture import PERMUTATIONS, encode, encode_fingertips


def triples(n: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    points = 0.05 * torch.randn(n, 3, 3, generator=generator, dtype=torch.float64)
    return points, unit(torch.randn(n, 3, 3, generator=generator, dtype=torch.float64))


def test_eq18_code_by_hand_and_bad_arguments(generator):
    points = real([[3.0, 0, 0], [0, 3, 0], [0, 0, 0]])
    normals = real([[1.0, 0, 0], [0, 1, 0], [-0.6, -0.8, 0]])
    wanted = [math.sqrt(5), math.sqrt(5), math.sqrt(2), 0.0, -0.6, -0.8]
    torch.testing.assert_close(encode_fingertips(points, normals), real(wanted))
    points, normals = triples(3, generator)
    with pytest.raises(BadArgument, match=r"normals: expected .*got a normal of length 2"):
        encode((points, 2 * normals))
    with pytest.raises(BadArgument, match=r"points: expected .*got nan"):
        encode((points * float("nan"), normals))
    with pytest.raises(BadArgument, match=r"normals: expected .*got shape"):
        encode((points, normals[:2]))


@pytest.mark.promise("N6")
def test_eq18_code_is_invariant_under_motion_and_sign_and_ties_no_normals_to_the_triangle(
    generator, motion
):
    points, normals = triples(100, generator)
    q = encode_fingertips(points, normals)
    torch.testing.assert_close(encode_fingertips(apply(motion, points), rotate(motion, normals)), q)
    torch.testing.assert_close(encode_fingertips(points, -normals), q)
    mirror = real([1.0, 1.0, -1.0])
    torch.testing.assert_close(
        encode_fingertips(points * mirror, normals), encode_fingertips(points, normals)
    )
    torch.testing.assert_close(
        encode_fingertips(points, rotate(motion, normals)), encode_fingertips(points, normals)
    )


def test_eq15_to_eq18_codes_and_frames_of_all_six_permutations(generator):
    points, normals = triples(20, generator)
    code = encode((points, normals))
    assert (
        [tuple(p) for p in code.permutation.tolist()]
        == list(PERMUTATIONS)
        == list(itertools.permutations(range(3)))
    )
    assert code.q.shape == (20, 6, 6)
    for k, order in enumerate(PERMUTATIONS):
        torch.testing.assert_close(
            code.q[:, k], encode_fingertips(points[:, list(order)], normals[:, list(order)])
        )
    for k, order in enumerate(PERMUTATIONS):
        torch.testing.assert_close(code.obj_from_vf[:, k], virtual_frame(points[:, list(order)]))
        local = apply(inverse(code.obj_from_vf[:, k]), points[:, list(order)])
        near(local.mean(1), torch.zeros(20, 3, dtype=torch.float64), 1e-12)
        assert bool((local[:, 2, 0] > local[:, 0, 0]).all())
        assert float(local[..., 2].abs().max()) < 1e-12


@pytest.mark.promise("I7")
def test_contacts_pairs_empty_batches_and_float32(generator):
    points, normals = triples(5, generator)
    contacts = Contacts(points, normals)
    assert torch.equal(encode(contacts).q, encode((points, normals)).q)
    assert encode(contacts[2]).q.shape == (1, 6, 6)
    assert encode((torch.zeros(0, 3, 3), torch.zeros(0, 3, 3))).q.shape == (0, 6, 6)
    points, normals = triples(3, generator)
    code = encode((points.float(), normals.float()))
    assert code.q.dtype == code.obj_from_vf.dtype == torch.float32


@pytest.mark.promise("I9")
def test_degenerate_rows_carry_a_status(generator):
    points, normals = triples(4, generator)
    points[1] = points[1, 0]  # coincident
    points[2] = points[2, :1] + torch.arange(3.0, dtype=torch.float64)[:, None] * 0.01  # on a line
    code = encode((points, normals))
    assert code.status.tolist() == [Status.OK, Status.DEGENERATE, Status.DEGENERATE, Status.OK]
    assert bool(code.q[1:3].isnan().all())
    assert bool(code.obj_from_vf[1:3].isnan().all())
    assert bool(code.q[[0, 3]].isfinite().all())
    torch.testing.assert_close(code.obj_from_vf[3, 0], virtual_frame(points[3]))
