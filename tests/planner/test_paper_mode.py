"""The paper's chain from cloud to ranked grasps, judged by geometry of its own."""

import pytest
import torch

from tests.make import load_hand, near
from torchgrasp import ContactSpec, Status, load_object, plan_grasps
from torchgrasp.geometry.frames import apply, virtual_frame
from torchgrasp.ik.candidates import PAPER_TOLERANCE
from torchgrasp.posture_model.mixture import PAPER_ENERGY, load_mixture
from torchgrasp.posture_model.sample import sample_configurations
from torchgrasp.shape.surface import extract_surface
from torchgrasp.success.order import rank_by_variance

SPEC = ContactSpec.paper(table=0.0)


@pytest.fixture(scope="module")
def run():
    stages = {}
    hand = load_hand("allegro")
    view = load_object("jug").view
    note = lambda stage, text, value: stages.update({stage: value})  # noqa: E731
    return hand, plan_grasps(view, hand, SPEC, starts=6, mode="paper", observer=note), stages


def test_shape_contacts_eq21_seeds_and_ranking_are_the_papers(run):
    _, grasps, stages = run
    shape = stages["shape"]
    assert (
        len(shape.x) == 70 and int((~shape.has_normal).sum()) == 21
    )  # the centre and 20 points outside
    assert grasps.meta["mode"] == "paper" and grasps.meta["ranking"] == "variance"
    estimate = shape.predict(grasps.contacts.points)
    assert float(estimate.variance.max()) < 0.03 + 1e-6  # Eq. (12)
    assert bool(grasps.certificate.closed.all())  # Eq. (13) at the whole friction
    good = grasps.executable
    assert len(good) >= 1
    assert bool((good.contacts.variance.sum(1).diff() >= 0).all())
    hand, _, stages = run
    seeds = stages["query"]
    assert len(seeds) and float(seeds.energy.max()) < PAPER_ENERGY
    assert bool((seeds.joints >= hand.lower).all()) and bool((seeds.joints <= hand.upper).all())
    _, grasps, _ = run
    mixed = grasps[torch.randperm(len(grasps), generator=torch.Generator().manual_seed(0))]
    ranked = rank_by_variance(mixed)
    assert torch.equal(
        ranked.status != Status.OK, (ranked.status != Status.OK).sort(stable=True).values
    )
    good = ranked.executable
    total = good.contacts.variance.sum(1)
    assert torch.equal(total, total.sort().values)
    assert sorted(ranked.score.tolist()) == sorted(mixed.score.tolist())


def test_every_assignment_that_eq21_accepts_is_tried_until_enough_grasps_are_executable(run):
    _, grasps, stages = run
    seeds = stages["query"]
    tried = seeds[: len(grasps)]
    assert len(tried) > len(tried.row.unique()) > 1  # several assignments of one triple
    assert sorted(tried.permutation.tolist()) == sorted(grasps.permutation.tolist())
    assert len(grasps) == len(seeds) or int((grasps.status == Status.OK).sum()) >= 10


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_the_model_of_mode_paper_knows_small_triples_better(name):
    hand = load_hand(name)
    own, other = (
        load_mixture(hand.urdf_path.parent / f"{file}.safetensors") for file in ("paper", "mixture")
    )
    samples = sample_configurations(hand, 3000, seed=5, sampling="grasping")
    small = samples.q[samples.q[:, :3].mean(1) < 0.045]
    accepted = [
        float((model.energy(small) < PAPER_ENERGY).double().mean()) for model in (own, other)
    ]
    assert len(small) > 30 and accepted[0] > 1.2 * accepted[1]


def test_eq24_contact_points_meet_the_contacts_and_the_hand_is_clear(run):
    hand, grasps, stages = run
    good = grasps.executable
    tips = hand.fingertips(good.joints)[0]
    placed = apply(good.obj_from_hand, tips)
    assert float((placed - good.contacts.points).norm(dim=-1).max()) <= PAPER_TOLERANCE
    near(good.obj_from_hand @ virtual_frame(tips), virtual_frame(good.contacts.points), 1e-6)
    cover = hand.collision_spheres
    for joints in (good.joints, good.pregrasp):
        hand.check_joints(joints)
        assert float(hand.self_clearance(joints).min()) >= 0
        heights = apply(good.obj_from_hand, hand.sphere_centres(joints))[..., 2] - cover.radius
        assert float(heights.min()) >= SPEC.table
    surface = extract_surface(stages["shape"])
    links = apply(good.obj_from_hand, hand.sphere_centres(good.joints))[:, ~cover.touching]
    for centre, radius in zip(
        links.flatten(0, 1), cover.radius[~cover.touching].repeat(len(good)), strict=True
    ):
        away = centre - surface.vertices
        nearest = int(away.norm(dim=-1).argmin())
        # vertices are 4 mm apart, so their tangent planes tell the distance to a millimetre or two
        assert float(away[nearest] @ surface.normals[nearest]) > 0
        assert float(away[nearest].norm()) > float(radius) - 0.002
