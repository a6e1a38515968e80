"""What the planner makes of one view of a jug with a handle, up to certified contacts, made once."""

import dataclasses
import functools
from typing import NamedTuple

import pytest

from tests.make import load_hand
from torchgrasp import (
    ContactSpec,
    Grasps,
    ShapeGP,
    Status,
    certify,
    fit_shape,
    load_object,
    plan_contacts,
)
from torchgrasp.geometry.signed_distance import field_from_surface
from torchgrasp.ik import (
    CollisionWorld,
    GraspProblem,
    PostureLibrary,
    nearest_postures,
    solve_joint,
)
from torchgrasp.shape.surface import Surface, extract_surface


class Jug(NamedTuple):
    """A problem on certified contacts, and what it was made of."""

    problem: GraspProblem
    library: PostureLibrary
    shape: ShapeGP
    surface: Surface
    spec: ContactSpec

    def solve(self, obstacles=None, reachable=None) -> Grasps:
        """The grasps among obstacles."""
        world = dataclasses.replace(self.problem.world, obstacles=obstacles)
        seeds = nearest_postures(self.library, self.problem.contacts, world, reachable=reachable)
        problem = dataclasses.replace(self.problem, world=world, reachable=reachable)
        return solve_joint(problem, seeds, self.shape, self.spec)


@functools.cache
def jug_shape() -> tuple[ShapeGP, Surface]:
    shape = fit_shape(load_object("jug").view, seed=0, table=0.0)
    return shape, extract_surface(shape)


@pytest.fixture(scope="session")
def jugs():
    """Make the jug's problem for a number of fingertips."""

    @functools.cache
    def make(fingertips: int) -> Jug:
        spec = ContactSpec(table=0.0, fingertips=fingertips)
        (shape, surface) = jug_shape()
        plan = plan_contacts(shape, spec, starts=18, seed=2)
        hand = load_hand("allegro", fingertips)
        certificate = certify(plan.contacts, spec)
        good = (plan.status == Status.OK) & certificate.closed
        world = CollisionWorld(field_from_surface(surface.vertices, surface.faces), spec.table)
        problem = GraspProblem(
            hand, plan.contacts[good], certificate[good], world, surface.vertices.mean(0)
        )
        return Jug(problem, PostureLibrary.of(hand, 600), shape, surface, spec)

    return make


@pytest.fixture(scope="session")
def jug_grasps(jugs):
    """Make the jug's grasps for a number of fingertips."""
    return functools.cache(lambda fingertips: jugs(fingertips).solve())
