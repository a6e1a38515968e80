"""The whole chain on a shipped view: every returned grasp is judged again, by code of its own."""

import functools

import pytest
import torch

from tests.make import closure_margin, load_hand, near
from torchgrasp import (
    ContactPlan,
    Contacts,
    ContactSpec,
    Grasps,
    GraspTask,
    PointCloud,
    Status,
    explain_empty,
    load_grasps,
    load_object,
    plan_grasps,
    stream_grasps,
)
from torchgrasp.foundation.base import named_tensors
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply, inverse, rotate
from torchgrasp.geometry.plane import Plane, move
from torchgrasp.ik.seeds import query_mixture
from torchgrasp.planner.objects import digest
from torchgrasp.planner.rows import spread_rows
from torchgrasp.posture_model.mixture import DEFAULT_ENERGY, encode_fingertips, load_mixture
from torchgrasp.success.model import load_success_model
from torchgrasp.success.order import by_success, grade
from torchgrasp.success.promise import Promise
from torchgrasp.success.reasons import measure_again, stand_upright

SPEC = ContactSpec(table=0.0)
VIEW = load_object("cylinder").view


@functools.cache
def usual() -> Grasps:
    """The grasps of the view without a task or a promise."""
    return plan_grasps(VIEW, load_hand("barrett"), SPEC, starts=12)


@pytest.mark.promise("N1")
def test_eq13_every_grasp_passes_an_independent_programme_and_is_within_reach(run):
    _, grasps, _ = run
    good = grasps.executable
    assert len(good) > 0
    # 24 edges: whoever shares no frame with the planner's cone may use a finer one
    for grasp in good:
        margin, rank = closure_margin(
            grasp.contacts.points[0], grasp.contacts.normals[0], SPEC.planned_friction
        )
        assert margin > 1e-8 and rank == 6
    hand, grasps, _ = run
    contacts = grasps.executable.contacts
    mixture = load_mixture(hand.name)
    assert len(contacts) > 20
    within = mixture.energy(encode_fingertips(contacts.points, contacts.normals)) < DEFAULT_ENERGY
    assert float(within.double().mean()) > 0.9  # finger i touches contact i
    assert len(query_mixture(hand, contacts, mixture, n_seeds=1).row.unique()) > 0.95 * len(
        contacts
    )


def test_the_likelier_success_ranks_first_and_failures_stay_last(run):
    _, grasps, _ = run
    good = grasps.status == Status.OK
    assert bool((good[:-1] | ~good[1:]).all())  # none good after a bad one
    scores = grasps.score[good]
    assert bool((scores[:-1] >= scores[1:]).all())
    good = int((grasps.status == Status.OK).sum())
    odds = torch.randn(good, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    ranked = by_success(grade(grasps, odds, torch.ones(good, dtype=torch.float64)))
    assert torch.equal(ranked.score[:good], odds.sort(descending=True).values.to(grasps.score))
    assert bool((ranked.status[:good] == Status.OK).all()) and not bool(
        (ranked.status[good:] == Status.OK).any()
    )
    torch.testing.assert_close(ranked.success[:good], torch.sigmoid(ranked.score[:good]))
    assert not bool(ranked.success[good:].any())


def test_success_is_what_the_model_says_of_the_features_that_an_explanation_measures_again(run):
    hand, grasps, stages = run
    best = grasps.executable[:5]
    odds = load_success_model().log_odds(
        measure_again(*stand_upright(best, hand, stages["shape"]), GraspTask())[0]
    )
    torch.testing.assert_close(best.success, torch.sigmoid(odds), rtol=1e-6, atol=1e-6)
    near(best.interval, load_success_model().interval(odds), 1e-6)


# a mass that the fingers carry with ease: otherwise the odds would fall by `lost_by_weakness`, too
LIGHT = GraspTask(mass=0.35)


@pytest.mark.parametrize("task", [GraspTask(mass=0.02, force=8.0, lift=False), LIGHT])
def test_a_task_changes_the_predictions_and_not_the_grasps(task):
    hand = load_hand("barrett")
    shapes = []
    note = lambda stage, text, value: shapes.append(value) if stage == "shape" else None  # noqa: E731
    grasps = plan_grasps(VIEW, hand, SPEC, starts=12, task=task, observer=note)
    best = grasps.executable
    odds = load_success_model().log_odds(
        measure_again(*stand_upright(best, hand, shapes[0]), task)[0]
    )
    near(best.score, odds, 1e-6)
    assert grasps.meta["task"] == task.describe() != usual().meta["task"]
    first, second = (
        set(map(tuple, found.executable.joints.tolist())) for found in (usual(), grasps)
    )
    assert (
        first <= second or second <= first
    )  # further constraints are tried where no grasp is likely to hold


def test_a_promise_refuses_the_less_likely_grasps_of_the_same_plan(monkeypatch):
    hand = load_hand("barrett")
    expected = usual().score
    bound = float(expected[usual().status == Status.OK].median())
    monkeypatch.setattr(
        "torchgrasp.success.order.find_promise", lambda share: Promise(bound, 400, 100)
    )
    kept = plan_grasps(VIEW, hand, SPEC, starts=12, promise=0.9)
    sure, refused = (kept[kept.status == status] for status in (Status.OK, Status.NO_PROMISE))
    assert (
        len(sure)
        and len(refused)
        and bool((sure.score >= bound).all())
        and bool((refused.score < bound).all())
    )
    assert torch.equal(kept.score[: len(sure) + len(refused)], expected[: len(sure) + len(refused)])
    assert not bool(refused.success.any()) and kept.meta["promise"].startswith("0.9")
    monkeypatch.setattr("torchgrasp.success.order.find_promise", lambda share: None)
    none = plan_grasps(VIEW, hand, SPEC, starts=12, promise=0.9)
    assert len(none) and int(Status.OK) not in none.status.tolist()


@pytest.mark.promise("N5")
def test_grasps_depend_on_the_seed_and_not_on_the_frame_of_cloud_camera_and_table(motion):
    hand = load_hand("barrett")
    view = VIEW.to(torch.float64)
    shapes = []
    note = lambda stage, text, value: shapes.append(value) if stage == "shape" else None  # noqa: E731
    here = plan_grasps(view, hand, SPEC, starts=12, observer=note)
    table = Plane.horizontal(0.0).moved(motion)
    there = plan_grasps(
        move(view, motion), hand, ContactSpec(table=table), starts=12, observer=note
    )
    back = named_tensors(move(there, inverse(motion)))
    for name, x in named_tensors(here).items():
        torch.testing.assert_close(back[name], x, rtol=0, atol=1e-9, msg=name)
    first, second = (
        s.predict(p) for s, p in zip(shapes, (view.points, apply(motion, view.points)), strict=True)
    )
    near(first.distance, second.distance, 1e-6)
    near(first.std_m, second.std_m, 1e-6)
    near(rotate(motion, first.normal), second.normal, 1e-5)
    other = plan_grasps(view, hand, SPEC, starts=12, seed=1).obj_from_hand
    assert len(here) and not (
        here.obj_from_hand.shape == other.shape and torch.allclose(here.obj_from_hand, other)
    )


def test_tips_limits_clearances_and_the_specification_hold(run):
    hand, grasps, _ = run
    good = grasps.executable
    assert float(good.tip_error.max()) <= 0.002
    for joints in (good.joints, good.pregrasp):
        hand.check_joints(joints)
        assert float(hand.self_clearance(joints).min()) >= 0
    centres = apply(good.obj_from_hand, hand.tip_centres(good.joints))
    touching = centres - hand.tips.radius[:, None] * good.contacts.normals
    assert float((touching - good.contacts.points).norm(dim=-1).max()) <= 0.002 + 1e-9
    spheres = apply(good.obj_from_hand, hand.sphere_centres(good.joints))
    assert float((spheres[..., 2] - hand.collision_spheres.radius).min()) >= SPEC.table
    _, grasps, stages = run
    contacts = grasps.executable.contacts
    estimate = stages["shape"].predict(contacts.points)
    assert float(estimate.distance.abs().max()) <= 1e-5
    assert float(estimate.variance.max()) <= SPEC.max_variance + 1e-6
    near(estimate.normal, contacts.normals, 1e-6)
    # the planner's variance is k0 - k A k, the estimate's k0 - |L^-1 k|^2: they part at the last
    # digits of k0
    near(estimate.std_m, contacts.std_m, 1e-7)
    centres = (
        contacts.points + 0.012 * contacts.normals
    )  # of fingertips that lie apart, on the table or above
    assert float((centres - centres.roll(1, 1)).norm(dim=-1).min()) >= SPEC.least_separation - 1e-6
    assert float(centres[..., 2].min()) >= 0.012 - 1e-6


def test_the_file_names_everything_and_stages_come_in_the_order_of_the_flow(run, tmp_path):
    hand, grasps, _ = run
    grasps.save(tmp_path / "grasps.safetensors")
    meta = load_grasps(tmp_path / "grasps.safetensors").meta
    assert meta["hand"] == hand.name
    assert meta["joint_names"].split(",") == list(hand.joint_names)
    assert meta["hand_sha256"] == hand.source.sha256
    model = {"joint": 4, "contact_first": 64}[
        meta["mode"]
    ]  # "none", since none is asked, or its hash
    assert len(meta["mixture_sha256"]) == model
    assert meta["cloud_sha256"] == digest(VIEW)
    assert {"units", "frames", "seed", "friction", "table", "starts"} <= set(meta)
    batches = ["batch"] if run[1].meta["mode"] == "joint" else []
    assert list(run[2]) == ["shape", *batches, "plan", "certify", "query", "refine"]


@pytest.mark.parametrize("call", [plan_grasps, stream_grasps, explain_empty])
def test_bad_arguments_are_refused_before_any_work(call):
    hand = load_hand("barrett")
    for name, bad in (
        ("starts", 0),
        ("mode", "best"),
        ("ranking", "best"),
        ("colour", "red"),
        ("task", 0.5),
        ("promise", 0.4),
        ("promise", 1.0),
    ):
        with pytest.raises((BadArgument, TypeError), match=name):
            call(VIEW, hand, **{name: bad})
    with pytest.raises((BadArgument, TypeError), match="hand"):
        call(VIEW, 3)


def test_no_triples_is_an_answer_and_spread_rows_are_far_apart():
    """On a cylinder with friction 0 three contacts never close: no grasp, and the statuses say why."""
    seen = []
    note = lambda stage, text, value: seen.append(text)  # noqa: E731
    assert (
        len(
            plan_grasps(
                VIEW, load_hand("barrett"), ContactSpec(friction=0.0), starts=5, observer=note
            )
        )
        == 0
    )
    assert "not_closed" in seen[1]
    rng = torch.Generator().manual_seed(0)
    points = torch.rand(50, 3, 3, generator=rng, dtype=torch.float64)
    points[25:] = points[24]  # half of the plan is one triple
    status = torch.zeros(50, dtype=torch.int64)
    status[3] = Status.NOT_CLOSED
    plan = ContactPlan(
        Contacts(points, points),
        torch.zeros(50, 3, 8),
        torch.arange(50, dtype=torch.float64),
        status,
    )
    rows = spread_rows(plan, 20)
    assert len(rows) == 20
    assert 3 not in rows.tolist()
    assert int((rows >= 24).sum()) <= 1
    assert len(spread_rows(plan, 100)) == 49


@pytest.mark.filterwarnings("ignore::torchgrasp.foundation.errors.CloudWarning")
@pytest.mark.parametrize("rows", [slice(0, 20), slice(0, None)])
def test_success_is_unknown_where_the_cloud_has_few_points_or_one_flat_face(rows):
    draw = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    face = draw * torch.tensor([0.0, 0.08, 0.12]) + torch.tensor([0.0, 0.0, 0.06])
    seen = VIEW.points[rows] if rows.stop else face
    grasps = plan_grasps(
        PointCloud(seen, viewpoint=VIEW.viewpoint), load_hand("barrett"), SPEC, starts=20
    )
    good = grasps.executable
    assert len(good) and bool(good.success.isnan().all())


def test_nothing_is_promised_of_an_object_that_may_be_elsewhere():
    task = GraspTask(displaced=True)
    with pytest.raises(
        BadArgument, match=r"promise: expected None, got 0\.9 for a displaced object"
    ):
        plan_grasps(VIEW, load_hand("barrett"), SPEC, starts=5, task=task, promise=0.9)
