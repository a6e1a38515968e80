"""The whole chain on a shipped view: every returned grasp is judged again, by code of its own."""

import json
import math

import numpy as np
import pytest
import torch
from scipy.optimize import linprog

from torchgrasp import ContactSpec, PointCloud, Status, load_grasps, load_hand, load_object, plan_grasps
from torchgrasp.base import named_tensors
from torchgrasp.errors import BadArgument, SuspiciousScale
from torchgrasp.geometry.frames import apply, inverse, rigid, rotate, rotation_from_vector
from torchgrasp.geometry.plane import Plane, move, upright_frame
from torchgrasp.ik.ranking import FEATURES, MODEL, rank_by_success, success_features
from torchgrasp.ik.seeds import query_mixture
from torchgrasp.planner.contacts import spread_rows
from torchgrasp.planner.problem import digest
from torchgrasp.posture_model.mixture import DEFAULT_ENERGY, encode_fingertips, load_mixture
from torchgrasp.shape.surface import extract_surface
from torchgrasp.values import ContactPlan, Contacts

SPEC = ContactSpec(friction=0.8, table=0.0)


@pytest.fixture(scope="module", params=[("allegro", "joint"), ("barrett", "joint"), ("barrett", "contact_first")])
def run(request):
    stages = {}
    name, mode = request.param
    hand, view = load_hand(name), load_object("cylinder").view
    note = lambda stage, text, value: stages.update({stage: value})  # noqa: E731
    grasps = plan_grasps(view, hand, SPEC, starts=60, seed=1, mode=mode, observer=note)
    return hand, grasps, stages


def closure_margin(points: np.ndarray, normals: np.ndarray, friction: float, edges: int) -> tuple[float, int]:
    """Largest s of Eq. 13: phi >= s > 0, sum phi = 1, sum phi w = 0; and the rank of the wrenches. Numpy alone."""
    center = points.mean(0)
    radius = np.linalg.norm(points - center, axis=1).max()
    columns = []
    for p, n in zip(points, -normals, strict=True):
        helper = np.eye(3)[np.argmin(np.abs(n))]
        t1 = np.cross(n, helper)
        t1 /= np.linalg.norm(t1)
        t2 = np.cross(n, t1)
        for k in range(edges):
            a = 2 * math.pi * k / edges
            force = n + friction * (math.cos(a) * t1 + math.sin(a) * t2)
            columns.append(np.concatenate([force, np.cross((p - center) / radius, force)]))
    w = np.array(columns).T
    m = w.shape[1]
    # variables (phi, s): maximise s
    equalities = np.zeros((7, m + 1))
    equalities[:6, :m], equalities[6, :m] = w, 1.0
    lower = np.hstack([-np.eye(m), np.ones((m, 1))])
    found = linprog(
        np.r_[np.zeros(m), -1.0],
        A_ub=lower,
        b_ub=np.zeros(m),
        A_eq=equalities,
        b_eq=np.r_[np.zeros(6), 1.0],
        bounds=[(None, None)] * (m + 1),
    )
    return (-found.fun if found.status == 0 else -np.inf), int(np.linalg.matrix_rank(w, tol=1e-3))


@pytest.mark.promise("N1")
def test_eq13_every_grasp_passes_an_independent_programme(run):
    _, grasps, _ = run
    good = grasps[grasps.status == Status.OK]
    assert len(good) > 0
    # 24 edges: whoever shares no frame with the planner's cone may use a finer one
    for grasp in good:
        points, normals = grasp.contacts.points[0].numpy(), grasp.contacts.normals[0].numpy()
        margin, rank = closure_margin(points, normals, SPEC.planned_friction, 24)
        assert margin > 1e-8
        assert rank == 6


def test_the_best_come_first(run):
    _, grasps, _ = run
    good = grasps.status == Status.OK
    assert bool((good[:-1] | ~good[1:]).all())  # none good after a bad one
    scores = grasps.score[good]
    assert bool((scores[:-1] >= scores[1:]).all())


def test_the_likelier_success_ranks_first_and_failures_stay_last(run):
    _, grasps, _ = run
    good = int((grasps.status == Status.OK).sum())
    odds = torch.randn(good, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    ranked = rank_by_success(grasps, odds)
    assert torch.equal(ranked.score[:good], odds.sort(descending=True).values.to(grasps.score))
    assert bool((ranked.status[:good] == Status.OK).all()) and not bool((ranked.status[good:] == Status.OK).any())
    torch.testing.assert_close(ranked.success[:good], torch.sigmoid(ranked.score[:good]))
    assert not bool(ranked.success[good:].any())


def test_success_is_what_the_model_says_of_the_surface_that_was_planned_on(run):
    hand, grasps, stages = run
    view = load_object("cylinder").view
    upright_from_obj = inverse(upright_frame(view.points, view.viewpoint, SPEC.plane))
    best = move(grasps[grasps.status == Status.OK][:5], upright_from_obj)
    shape = stages["shape"].moved(upright_from_obj)
    center = extract_surface(shape).vertices.mean(0)
    features = success_features(hand, shape, best, center, SPEC.friction, seed=1)
    model = json.loads(MODEL.read_text())
    odds = features @ torch.tensor([model["weights"][name] for name in FEATURES], dtype=features.dtype)
    torch.testing.assert_close(best.success, 1 / (1 + (-odds - model["bias"][hand.name]).exp()), rtol=1e-6, atol=1e-6)


@pytest.mark.promise("N5")
def test_grasps_do_not_depend_on_the_frame_of_cloud_camera_and_table(moved_by):
    hand, view, shapes = load_hand("barrett"), load_object("cylinder").view.to(torch.float64), []
    note = lambda stage, text, value: shapes.append(value) if stage == "shape" else None  # noqa: E731
    here = plan_grasps(view, hand, SPEC, starts=12, observer=note)
    table = Plane.horizontal(0.0).moved(moved_by)
    there = plan_grasps(move(view, moved_by), hand, ContactSpec(table=table), starts=12, observer=note)
    back = named_tensors(move(there, inverse(moved_by)))
    for name, x in named_tensors(here).items():
        torch.testing.assert_close(back[name], x, rtol=0, atol=1e-9, msg=name)
    first, second = (s.predict(p) for s, p in zip(shapes, (view.points, apply(moved_by, view.points)), strict=True))
    torch.testing.assert_close(first.distance, second.distance, rtol=0, atol=1e-6)
    torch.testing.assert_close(first.std_m, second.std_m, rtol=0, atol=1e-6)
    torch.testing.assert_close(rotate(moved_by, first.normal), second.normal, rtol=0, atol=1e-5)


@pytest.fixture(params=[0, 1])
def moved_by(request):
    draw = torch.randn(2, 3, generator=torch.Generator().manual_seed(request.param), dtype=torch.float64)
    return rigid(rotation_from_vector(3 * draw[0]), draw[1])


def test_tips_limits_and_clearances_hold(run):
    hand, grasps, _ = run
    good = grasps[grasps.status == Status.OK]
    assert float(good.tip_error.max()) <= 0.002
    for joints in (good.joints, good.pregrasp):
        hand.check_joints(joints)
        assert float(hand.self_clearance(joints).min()) >= 0
    centres = hand.tip_centres(good.joints)
    centres = centres @ good.obj_from_hand[:, :3, :3].transpose(1, 2) + good.obj_from_hand[:, None, :3, 3]
    touching = centres - hand.tips.radius[:, None] * good.contacts.normals
    assert float((touching - good.contacts.points).norm(dim=-1).max()) <= 0.002 + 1e-9
    spheres = hand.sphere_centres(good.joints)
    spheres = spheres @ good.obj_from_hand[:, :3, :3].transpose(1, 2) + good.obj_from_hand[:, None, :3, 3]
    assert float((spheres[..., 2] - hand.collision_spheres.radius).min()) >= SPEC.table


def test_executable_grasps_are_within_reach_of_the_learned_model(run):
    hand, grasps, _ = run
    contacts, mixture = grasps[grasps.status == Status.OK].contacts, load_mixture(hand.name)
    assert len(contacts) > 20
    within = mixture.energy(encode_fingertips(contacts.points, contacts.normals)) < DEFAULT_ENERGY
    assert float(within.double().mean()) > 0.9  # finger i touches contact i
    assert len(query_mixture(hand, contacts, mixture, n_seeds=1).row.unique()) > 0.95 * len(contacts)


def test_contacts_satisfy_the_spec(run):
    _, grasps, stages = run
    contacts = grasps[grasps.status == Status.OK].contacts
    estimate = stages["shape"].predict(contacts.points)
    assert float(estimate.distance.abs().max()) <= 1e-5
    assert float(estimate.variance.max()) <= SPEC.max_variance + 1e-6
    torch.testing.assert_close(estimate.normal, contacts.normals, atol=1e-6, rtol=0)
    # the planner's variance is k0 - k A k, the estimate's k0 - |L^-1 k|^2: they part at the last digits of k0
    torch.testing.assert_close(estimate.std_m, contacts.std_m, atol=1e-7, rtol=0)
    centres = contacts.points + 0.012 * contacts.normals  # of fingertips that lie apart, on the table or above
    assert float((centres - centres.roll(1, 1)).norm(dim=-1).min()) >= SPEC.least_separation - 1e-6
    assert float(centres[..., 2].min()) >= 0.012 - 1e-6


def test_the_file_names_everything(run, tmp_path):
    hand, grasps, _ = run
    grasps.save(tmp_path / "grasps.safetensors")
    meta = load_grasps(tmp_path / "grasps.safetensors").meta
    assert meta["hand"] == hand.name
    assert meta["joint_names"].split(",") == list(hand.joint_names)
    assert meta["hand_sha256"] == hand.source.sha256
    model = {"joint": 4, "contact_first": 64}[meta["mode"]]  # "none", since none is asked, or its hash
    assert len(meta["mixture_sha256"]) == model
    assert meta["cloud_sha256"] == digest(load_object("cylinder").view)
    assert {"units", "frames", "seed", "friction", "table", "starts"} <= set(meta)


def test_stages_come_in_the_order_of_the_flow(run):
    batches = ["batch"] if run[1].meta["mode"] == "joint" else []
    assert list(run[2]) == ["shape", *batches, "plan", "certify", "query", "refine"]


def test_bad_arguments_are_refused_before_any_work():
    view, hand = load_object("cylinder").view, load_hand("barrett")
    with pytest.raises(SuspiciousScale, match="mm"):
        plan_grasps(PointCloud(view.points * 1000), hand)
    with pytest.raises((BadArgument, TypeError)):
        plan_grasps(view, "barrett")
    with pytest.raises((BadArgument, TypeError), match="starts"):
        plan_grasps(view, hand, starts=0)
    with pytest.raises((BadArgument, TypeError), match="mode"):
        plan_grasps(view, hand, mode="best")  # pyright: ignore[reportArgumentType]
    with pytest.raises((BadArgument, TypeError), match="ranking"):
        plan_grasps(view, hand, ranking="best")  # pyright: ignore[reportArgumentType]


def test_another_seed_gives_other_grasps_and_the_same_seed_the_same():
    view, hand = load_object("cylinder").view, load_hand("barrett")
    one, two, again = (plan_grasps(view, hand, SPEC, starts=10, seed=seed).obj_from_hand for seed in (1, 2, 1))
    assert torch.equal(one, again) and len(one) and not (one.shape == two.shape and torch.allclose(one, two))


def test_no_triples_is_an_answer():
    """On a cylinder with friction 0 three contacts never close: no grasp, and the statuses say why."""
    seen = []
    grasps = plan_grasps(
        load_object("cylinder").view,
        load_hand("barrett"),
        ContactSpec(friction=0.0),
        starts=20,
        observer=lambda stage, text, value: seen.append(text),
    )
    assert len(grasps) == 0
    assert "not_closed" in seen[1]


def test_spread_rows_are_far_apart():
    rng = torch.Generator().manual_seed(0)
    points = torch.rand(50, 3, 3, generator=rng, dtype=torch.float64)
    points[25:] = points[24]  # half of the plan is one triple
    status = torch.zeros(50, dtype=torch.int64)
    status[3] = Status.NOT_CLOSED
    plan = ContactPlan(Contacts(points, points), torch.zeros(50, 3, 8), torch.arange(50, dtype=torch.float64), status)
    rows = spread_rows(plan, 20)
    assert len(rows) == 20
    assert 3 not in rows.tolist()
    assert int((rows >= 24).sum()) <= 1
    assert len(spread_rows(plan, 100)) == 49
