"""Attempts: which seeds are refined in which round, the best result of each row, and grasps on
fixed contacts.
"""

import dataclasses

import pytest
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from tests.make import field_of_mesh, real
from torchgrasp import load_hand, load_mixture
from torchgrasp.foundation.base import Batch, rank_in_group
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.geometry.frames import apply
from torchgrasp.ik import CollisionWorld, GraspProblem
from torchgrasp.ik.attempts import Attempts, assign, solve_contact_first
from torchgrasp.ik.seeds import query_mixture
from torchgrasp.values.planning import Certificate, Contacts, IKSeeds


@dataclasses.dataclass(frozen=True)
class Outcome(Batch):
    """A status and an error for each seed."""

    error: Float[Tensor, "k"]
    status: Int[Tensor, "k"]


def seeds_of(row: list[int], energy: list[float]) -> IKSeeds:
    """Seeds that `energy` tells apart."""
    g = len(row)
    order = torch.arange(3).expand(g, 3)
    poses = torch.eye(4).expand(g, 4, 4)
    return IKSeeds(
        torch.zeros(g, 4), poses, torch.tensor(row), order, torch.tensor(energy), torch.zeros(g, 3)
    )


def by_sign(refined: list[list[float]]):
    """A refinement that solves the seeds of negative energy, and keeps a record."""

    def refine(seeds: IKSeeds) -> Outcome:
        refined.append(seeds.energy.tolist())
        failed = (seeds.energy >= 0).long() * int(Status.TIP_ERROR)
        return Outcome(seeds.energy.abs(), failed)

    return refine


def solves(outcome: Outcome) -> Tensor:
    return outcome.status == Status.OK


def test_later_rounds_refine_only_unsolved_triples_and_the_best_is_a_success_or_the_least_error():
    refined = []
    seeds = seeds_of([0, 0, 0, 1, 1, 1, 2], [5.0, -1.0, -2.0, 4.0, 3.0, -6.0, -7.0])
    attempts = Attempts(torch.tensor([True, True, False, True]), solves)
    attempts.refine(seeds, rank_in_group(seeds.row), [1, 1], by_sign(refined))
    assert refined == [[5.0, 4.0], [-1.0, 3.0]]  # triple 2 was not to be solved
    assert attempts.unsolved.tolist() == [False, True, False, True]
    attempts.refine(
        seeds, rank_in_group(seeds.row), [3], by_sign(refined)
    )  # another refinement starts anew
    assert refined[2:] == [[4.0, 3.0, -6.0]]
    assert attempts.unsolved.tolist() == [False, False, False, True]
    attempts = Attempts(torch.ones(3, dtype=torch.bool), solves)
    seeds = seeds_of([0, 0, 0, 1, 1], [2.0, -9.0, -8.0, 4.0, 3.0])
    attempts.refine(seeds, rank_in_group(seeds.row), [5], by_sign([]))
    best, row = attempts.best(lambda outcome: ((outcome.status != Status.OK).int(), outcome.error))
    assert dict(zip(row.tolist(), best.error.tolist(), strict=True)) == {0: 8.0, 1: 3.0}


def test_assign_gives_finger_i_its_contact(generator):
    points = torch.rand(4, 3, 3, generator=generator, dtype=torch.float64)
    flat = torch.rand(4, 3, generator=generator, dtype=torch.float64)
    permutation = torch.tensor([[2, 0, 1], [0, 1, 2]])
    seeds = IKSeeds(
        torch.zeros(2, 4),
        torch.eye(4).expand(2, 4, 4),
        torch.tensor([3, 1]),
        permutation,
        torch.zeros(2),
        torch.zeros(2, 3),
    )
    taken = assign(Contacts(points, -points, std_m=flat), seeds)
    torch.testing.assert_close(taken.points[0, 0], points[3, 2])
    torch.testing.assert_close(taken.normals[0, 2], -points[3, 1])
    torch.testing.assert_close(taken.std_m[1], flat[1])


def test_grasps_are_checked_and_ranked():
    """Contacts on a ball within the Barrett hand's reach: the executable grasps come first, best
    first.
    """
    hand = load_hand("barrett")
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.035)
    turn = torch.linspace(0, 1.5, 6, dtype=torch.float64)
    flat = torch.full((6, 3), 0.001, dtype=torch.float64)
    angle = turn[:, None] + real([0.0, 2.1, 4.2])
    normals = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)
    contacts = Contacts(0.035 * normals, normals, std_m=flat)
    ones = torch.ones(6, dtype=torch.float64)
    certificate = Certificate(
        torch.arange(6, dtype=torch.float64), ones, ones, ones > 0, ones[:, None].expand(6, 6)
    )
    world = CollisionWorld(field_of_mesh(mesh))
    center = torch.zeros(3, dtype=torch.float64)
    problem = GraspProblem(hand, contacts, certificate, world, center)
    seeds = query_mixture(hand, contacts, load_mixture("barrett"))
    grasps = solve_contact_first(problem, seeds)
    good = grasps.status == Status.OK
    assert good.sum() >= 3
    assert not (good[1:] & ~good[:-1]).any()
    for part in (grasps[good], grasps[~good]):
        assert (part.score.diff() <= 0).all()
    row = certificate.margin.tolist().index(float(grasps.certificate.margin[0]))
    torch.testing.assert_close(
        grasps.contacts.points[0], contacts.points[row, grasps.permutation[0]]
    )
    tips = apply(grasps.obj_from_hand, hand.tip_centres(grasps.joints))[good]
    gap = torch.linalg.vector_norm(tips, dim=-1) - 0.035 - hand.tips.radius
    assert float(gap.abs().max()) < 2.1e-3
    assert len(solve_contact_first(problem, seeds[:0])) == 0
    with pytest.raises(BadArgument, match="std_m"):
        dataclasses.replace(problem, contacts=dataclasses.replace(contacts, std_m=None))
