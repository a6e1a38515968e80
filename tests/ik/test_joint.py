"""Contacts, pose and joints solved together: the Jacobian, and grasps against oracles of their own."""

import dataclasses

import pytest
import torch

from torchgrasp import Status, certify
from torchgrasp.contacts.descent import normalise_tensions
from torchgrasp.contacts.feasibility import flatness_constraint
from torchgrasp.contacts.problem import ContactProblem, triple_jet
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply
from torchgrasp.ik.attempts import assign, solve_contact_first
from torchgrasp.ik.configuration import Configuration
from torchgrasp.ik.joint import JointProblem, JointState, solve_joint
from torchgrasp.ik.seeds import nearest_postures


@pytest.fixture(scope="module", params=[3, 4])
def fingertips(request):
    return request.param


@pytest.fixture(scope="module")
def scene(jugs, fingertips):
    """The problem, seeds for its contacts, the shape and the specification."""
    jug = jugs(fingertips)
    return (
        jug.problem,
        nearest_postures(jug.library, jug.problem.contacts, jug.problem.world),
        jug.shape,
        jug.spec,
    )


@pytest.fixture(scope="module")
def grasps(jug_grasps, fingertips):
    return jug_grasps(fingertips)


def test_guesses_of_another_hand_or_of_other_contact_sets_are_refused(scene):
    given, seeds, shape, spec = scene
    fewer_joints = dataclasses.replace(seeds, joints=seeds.joints[:, 1:])
    beyond = dataclasses.replace(seeds, row=seeds.row + len(given.contacts.points))
    for wrong, found in ((fewer_joints, "joints"), (beyond, "contact set")):
        with pytest.raises(BadArgument, match=rf"seeds: expected .*{found}"):
            solve_joint(given, wrong, shape, spec)


def test_a_centre_in_millimetres_is_refused(scene):
    """It would rank the grasps alone, by a distance that has no meaning."""
    given = scene[0]
    assert dataclasses.replace(given, center=given.center + 0.1) is not given
    with pytest.raises(BadArgument, match="center: expected one within 2 m, in metres"):
        dataclasses.replace(given, center=1000 * (given.center + 0.1))


def test_jacobian_of_the_joint_problem_against_finite_differences(scene, generator):
    given, seeds, shape, spec = scene
    hand = given.hand
    seeds = seeds[::4][:24]
    # steps must not meet the limits
    lower = hand.lower + 0.01
    upper = hand.upper - 0.01
    posture = Configuration(seeds.joints.clamp(lower, upper), seeds.obj_from_hand)
    points = shape.normalise(assign(given.contacts, seeds).points)
    points = points + 0.1 * torch.randn(points.shape, generator=generator, dtype=torch.float64)
    f = spec.fingertips
    pairs = spec.fingertips * (spec.fingertips - 1) // 2
    tension = normalise_tensions(
        points, torch.rand(24, pairs, generator=generator, dtype=torch.float64)
    )
    strict = dataclasses.replace(spec, max_variance=0.01)  # so that some points are too uncertain
    problem = JointProblem(given.hand, shape, ContactProblem.of(shape, strict), given.world)
    flat = flatness_constraint(shape, points, 0.2, spec.ring_radius / shape.scale)

    def rows(state: JointState):
        residual, jacobian = problem.residuals(state, flat)
        links = slice(
            4 * f, residual.shape[1] - 9 * f - pairs
        )  # no matter of the contacts, and tested in test_refine
        assert bool((jacobian[:, links, 6 + hand.dof :] == 0).all())
        rest = [*range(4 * f), *range(links.stop, residual.shape[1])]
        return residual[:, rest], jacobian[:, rest]

    jet = triple_jet(shape, points)
    state = JointState(posture, points, tension, jet.variance, jet.variance_gradient)
    jacobian = rows(state)[1]
    assert (
        int((jacobian != 0).any(2).any(0).sum()) >= 4 * f + f + 2 * f + 4 * f
    )  # all but ball, sides and table
    for k in range(jacobian.shape[2]):
        step = torch.zeros(24, jacobian.shape[2], dtype=torch.float64)
        step[:, k] = 3e-5
        above, below = (rows(state.integrate(hand, sign * step))[0] for sign in (1, -1))
        smooth = (above == 0) == (below == 0)  # no hinge opens in between
        slope = (above - below) / 6e-5
        # the variance has the fewest digits
        torch.testing.assert_close(jacobian[..., k][smooth], slope[smooth], rtol=1e-4, atol=0.2)


def test_hands_that_cannot_reach_are_given_up_and_the_others_named(scene):
    given, seeds, shape, spec = scene
    seeds = seeds[:16]
    far = torch.arange(16) % 2 == 0
    pose = seeds.obj_from_hand.clone()
    pose[far, 0, 3] += 5.0  # steps are short: no hand comes back from there
    start = Configuration(seeds.joints, pose)
    points = shape.normalise(assign(given.contacts, seeds).points)
    problem = JointProblem(given.hand, shape, ContactProblem.of(shape, spec), given.world)
    configuration, _, rows = problem.solve(start, points)
    assert len(rows) > 0 and not bool(far[rows].any()) and len(configuration) == len(rows)
    moved = torch.linalg.vector_norm(
        configuration.obj_from_hand[:, :3, 3] - pose[rows, :3, 3], dim=-1
    )
    assert float(moved.max()) < 0.2


def test_grasps_satisfy_every_constraint_and_links_are_outside_the_estimated_surface(scene, grasps):
    given, _, shape, spec = scene
    hand = given.hand
    world = given.world
    good = grasps.executable
    least = (
        0.85 if spec.fingertips == 3 else 0.15
    )  # contacts of four fingers are seldom in reach as planned
    assert len(good) >= least * len(given.contacts)
    seen = shape.predict(good.contacts.points)
    assert float(seen.distance.abs().max()) <= 1e-5
    assert float(seen.variance.max()) <= spec.max_variance + 1e-6
    torch.testing.assert_close(good.contacts.normals, seen.normal, atol=1e-6, rtol=0)
    assert bool(certify(good.contacts, spec).closed.all()) and bool(good.certificate.closed.all())
    tips = good.contacts.points + spec.fingertip_radius * good.contacts.normals
    assert (
        float(torch.linalg.vector_norm(tips - tips.roll(1, 1), dim=-1).min())
        >= spec.least_separation
    )
    centres = apply(good.obj_from_hand, hand.tip_centres(good.joints))
    gap = centres - good.contacts.points - hand.tips.radius[:, None] * good.contacts.normals
    assert float(torch.linalg.vector_norm(gap, dim=-1).max()) <= 1e-3
    assert bool((good.joints >= hand.lower).all()) and bool((good.joints <= hand.upper).all())
    cover = hand.collision_spheres
    for joints, links in ((good.joints, ~cover.touching), (good.pregrasp, cover.radius > 0)):
        spheres = apply(good.obj_from_hand, hand.sphere_centres(joints))
        assert float((spheres[..., 2] - cover.radius).min()) >= 0
        assert float((world.field.query(spheres)[0] - cover.radius)[:, links].min()) >= 0
        assert float(hand.self_clearance(joints).min()) >= 0
    hand = scene[0].hand
    shape = scene[2]
    centres = apply(good.obj_from_hand, hand.sphere_centres(good.joints))[
        :, ~hand.collision_spheres.touching
    ]
    near = torch.linalg.vector_norm(shape.normalise(centres), dim=-1) < shape.domain_radius
    assert int(near.sum()) > 100
    assert float(shape.predict(centres[near]).distance.min()) > 0


def test_sliding_contacts_find_more_grasps_than_still_ones_and_the_same_bits_again(scene, grasps):
    still = solve_contact_first(*scene[:2])
    better = int((grasps.status == Status.OK).sum()) - int((still.status == Status.OK).sum())
    assert better > 0
    begun = scene[0].contacts.points.flatten(1)
    ended = grasps.executable.contacts.points
    own = ended.gather(1, grasps.executable.permutation.argsort(1)[..., None].expand_as(ended))
    moved = torch.cdist(own.flatten(1), begun).amin(1)
    assert int((moved > 1e-4).sum()) >= better
    again = solve_joint(*scene)
    assert torch.equal(again.joints, grasps.joints) and torch.equal(again.status, grasps.status)
    assert torch.equal(again.contacts.points, grasps.contacts.points)
    assert len(solve_joint(scene[0], scene[1][:0], *scene[2:])) == 0
