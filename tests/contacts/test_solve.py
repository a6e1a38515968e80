"""Plans on an analytic shape: every constraint re-checked from outside, statuses, seeds, given
starts.
"""

import dataclasses
import itertools
import math

import pytest
import torch

from tests.make import near, real, spokes
from torchgrasp import ContactSpec, certify
from torchgrasp.contacts.descent import project
from torchgrasp.contacts.feasibility import check_feasibility, first_violation, normal_variation
from torchgrasp.contacts.form_closure import closed_exact, wrenches
from torchgrasp.contacts.plan import TO_CENTRE, plan_chunk, plan_contacts
from torchgrasp.contacts.problem import ContactProblem
from torchgrasp.contacts.starts import (
    STARTS_PER_CHUNK,
    FlatCandidates,
    candidate_rows,
    draw_in,
    drawn_starts,
    settle_flatness,
    start_chunks,
)
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.geometry.frames import degenerate
from torchgrasp.geometry.linalg import unit

SPECS = {
    "paper": ContactSpec.paper(),
    "table": ContactSpec(table=0.472, flatness=0.6, flat_radius=0.008),
}


@pytest.mark.parametrize("fingertips", [3, 4, 5])
@pytest.mark.parametrize("name", list(SPECS))
def test_eq10_to_eq13_hold_for_every_row_that_is_ok(ellipsoid, name, fingertips):
    spec = dataclasses.replace(SPECS[name], fingertips=fingertips)
    plan = plan_contacts(ellipsoid, spec, starts=60, seed=3)
    assert len(plan) == 60
    assert int((plan.status == Status.OK).sum()) >= 45
    good = plan[plan.status == Status.OK]
    x = ellipsoid.normalise(good.contacts.points)
    assert float(ellipsoid.value(x).abs().max()) <= 1e-6  # Eq. (10)
    gradient = x / real(ellipsoid.axes) ** 2
    torch.testing.assert_close(good.contacts.normals, unit(gradient))  # Eq. (11)
    torch.testing.assert_close(good.contacts.variance, ellipsoid.doubt_at(x))
    torch.testing.assert_close(
        good.contacts.std_m, 0.65 * 0.06 * ellipsoid.doubt_at(x).sqrt() / gradient.norm(dim=-1)
    )
    assert float(good.contacts.variance.max()) < spec.max_variance  # Eq. (12)
    assert bool(certify(good.contacts, spec).closed.all())  # Eq. (13)
    w = wrenches(good.contacts.points, good.contacts.normals, spec.planned_friction, spec.edges)
    assert float((good.coefficients[..., None] * w).sum((1, 2)).abs().max()) <= 1e-8
    assert float(good.coefficients.min()) > 0
    torch.testing.assert_close(
        good.coefficients.sum((1, 2)), torch.ones(len(good), dtype=torch.float64)
    )
    centres = good.contacts.points + spec.fingertip_radius * good.contacts.normals
    for one, other in itertools.combinations(centres.unbind(1), 2):
        assert float(torch.linalg.vector_norm(one - other, dim=-1).min()) >= spec.least_separation
    assert not bool(degenerate(good.contacts.points).any())
    if spec.table is not None:
        height = good.contacts.points[..., 2]
        tip = height + spec.fingertip_radius * (good.contacts.normals[..., 2] - 1)
        assert float(tip.min()) >= spec.table - 1e-12
    if spec.flatness is not None:
        assert (
            float(
                normal_variation(
                    ellipsoid, x, good.contacts.normals, spec.ring_radius / ellipsoid.scale
                ).max()
            )
            <= spec.flatness
        )


def test_eq14_contacts_approach_the_centre_of_the_shape(ellipsoid):
    plan = plan_contacts(ellipsoid, ContactSpec.paper(), starts=60, seed=1)
    good = plan[plan.status == Status.OK]
    centre = good.contacts.points.mean(1) - real(ellipsoid.center)
    torch.testing.assert_close(good.quality, torch.linalg.vector_norm(centre, dim=-1))
    assert float(good.quality.median()) < 0.002  # [m], of half axes of 30 to 60 mm
    settled = settle_flatness(ellipsoid, ContactSpec(), 0)
    first = next(drawn_starts(ellipsoid, settled, [60], 0))
    problem = ContactProblem.of(ellipsoid, settled.spec)
    plan = plan_chunk(ellipsoid, problem, first, TO_CENTRE)
    begun = check_feasibility(ellipsoid, problem, first)
    good = (plan.status == Status.OK) & (begun.status == Status.OK)
    assert int(good.sum()) > 5 and float(plan.quality[good].mean()) < 0.9 * float(
        begun.quality[good].mean()
    )


def test_same_seed_gives_the_same_bits_another_seed_another_plan_and_no_feasible_start_is_lost(
    ellipsoid,
):
    spec = SPECS["table"]
    one, two, other = (plan_contacts(ellipsoid, spec, starts=20, seed=s) for s in (5, 5, 6))
    assert torch.equal(one.contacts.points, two.contacts.points)
    assert torch.equal(one.status, two.status)
    assert not torch.equal(one.contacts.points, other.contacts.points)
    plan = plan_contacts(ellipsoid, spec, starts=40, seed=2)
    feasible = plan.contacts.points[plan.status == Status.OK]
    assert bool((plan_contacts(ellipsoid, spec, feasible).status == Status.OK).all())
    assert len(plan_contacts(ellipsoid, spec, feasible[:0])) == 0


def test_given_starts_keep_their_order_and_their_frame(ellipsoid, generator):
    starts = ellipsoid.metres(
        0.1 * unit(torch.randn(12, 3, 3, generator=generator, dtype=torch.float64))
    )
    forward = plan_contacts(ellipsoid, ContactSpec.paper(), starts)
    backward = plan_contacts(ellipsoid, ContactSpec.paper(), starts.flip(0))
    near(forward.contacts.points, backward.contacts.points.flip(0), 1e-6)
    elsewhere = dataclasses.replace(ellipsoid, center=(1.3, -0.2, 0.5))
    moved = plan_contacts(elsewhere, ContactSpec.paper(), starts + real([1.0, 0, 0]))
    near(moved.quality, forward.quality, 1e-6)


@pytest.mark.parametrize("spec", [ContactSpec.paper(), ContactSpec()])
def test_a_start_without_a_gradient_is_named_and_harms_no_other(ellipsoid, generator, spec):
    around = 0.3 * unit(torch.randn(4, 3, 3, generator=generator, dtype=torch.float64))
    around[1] = 0.0  # the gradient vanishes in the centre, so no step to the surface is defined
    plan, alone = (
        plan_contacts(ellipsoid, spec, ellipsoid.metres(s)) for s in (around, around[[0, 2, 3]])
    )
    assert plan.status[1] == Status.OUT_OF_DOMAIN
    torch.testing.assert_close(plan.contacts.points[[0, 2, 3]], alone.contacts.points)


def test_a_time_budget_bounds_how_many_starts_are_planned_and_changes_no_row(
    ellipsoid, monkeypatch
):
    now = [0.0]
    monkeypatch.setattr("torchgrasp.contacts.plan.time.monotonic", lambda: now[0])
    whole = plan_contacts(ellipsoid, ContactSpec.paper(), starts=120)

    def slow(shape, spec, first, stages, plan=plan_chunk):
        now[0] += 0.01 * len(first)  # [s]: a hundred starts a second
        return plan(shape, spec, first, stages)

    monkeypatch.setattr("torchgrasp.contacts.plan.plan_chunk", slow)
    for seconds, rows in ((1e-9, 25), (0.3, 25), (0.5, 50), (1.0, 100), (9.0, 120)):
        now[0] = 0.0
        part = plan_contacts(ellipsoid, ContactSpec.paper(), starts=120, time_budget=seconds)
        assert len(part) == rows
        assert now[0] <= max(seconds, 0.25) + 1e-6
        torch.testing.assert_close(part.contacts.points, whole.contacts.points[:rows])


def test_more_starts_only_add_rows(ellipsoid, monkeypatch):
    monkeypatch.setattr("torchgrasp.contacts.starts.STARTS_PER_CHUNK", 5)
    for spec in SPECS.values():
        few, many = (plan_contacts(ellipsoid, spec, starts=count) for count in (10, 15))
        torch.testing.assert_close(few.contacts.points, many.contacts.points[:10])


def test_far_starts_are_drawn_in_others_stay_and_chunks_hold_all(ellipsoid, generator):
    on = project(
        ellipsoid, 0.9 * unit(torch.randn(3, 3, 3, generator=generator, dtype=torch.float64)), 8
    )
    torch.testing.assert_close(draw_in(ellipsoid, on), on)
    drawn = draw_in(ellipsoid, 2 * on)
    torch.testing.assert_close(drawn.mean(1), torch.zeros(3, 3, dtype=torch.float64))
    assert float(torch.linalg.vector_norm(drawn, dim=-1).max()) <= 0.1 + 1e-12
    for count in (0, 1, 499, 500, 501, 1700):
        sizes = start_chunks(count)
        assert sum(sizes) == count and all(0 < size <= STARTS_PER_CHUNK for size in sizes)


@pytest.mark.parametrize(
    ("radius", "flat"),
    [(0.04, 0.008), (0.018, 0.006), (0.012, 0.004), (0.0085, 0.003), (0.004, 0.003)],
)
def test_contacts_of_a_ball_are_flat_within_the_widest_ring_that_it_offers(ellipsoid, radius, flat):
    ball = dataclasses.replace(ellipsoid, axes=(1.0, 1.0, 1.0), scale=radius, doubt=0.0)
    spec = ContactSpec()
    assert settle_flatness(ball, spec, 0).spec.flat_radius == flat
    plan, there = (
        plan_contacts(ball, s, starts=25)
        for s in (spec, dataclasses.replace(spec, flat_radius=flat))
    )
    assert torch.equal(plan.contacts.points, there.contacts.points)
    given = dataclasses.replace(spec, flat_radius=0.002)
    assert settle_flatness(ball, given, 0).spec == given
    assert settle_flatness(ball, ContactSpec.paper(), 0) == (ContactSpec.paper(), None, None)


@pytest.mark.parametrize("fingertips", [3, 4])
def test_starts_are_the_first_good_ones_of_all_that_are_drawn(ellipsoid, monkeypatch, fingertips):
    """Portions change nothing; starts that are missing are any candidates."""
    spec = dataclasses.replace(SPECS["table"], fingertips=fingertips)
    settled = settle_flatness(ellipsoid, spec, 0)
    problem = ContactProblem.of(ellipsoid, settled.spec)
    points, normals = settled.candidates

    def drawn(portion: int, apart: float) -> torch.Tensor:
        monkeypatch.setattr("torchgrasp.contacts.starts.LEAST_PORTION", portion)
        far = dataclasses.replace(problem, separation=apart)
        generator = torch.Generator().manual_seed(2)
        rows = candidate_rows(far, [settled.candidates], 12, generator)
        # the generator goes on from the same state
        return torch.cat([rows.flatten(), torch.rand(2, generator=generator).double()])

    for apart in (problem.separation, 10.0):
        assert torch.equal(drawn(1, apart), drawn(10_000, apart))
    generator = torch.Generator().manual_seed(2)
    size = 20 * 12, fingertips
    choice = torch.cat([torch.randint(len(points), size, generator=generator) for _ in range(8)])
    centres = points[choice] + problem.tip_radius * normals[choice]
    sides = torch.stack([torch.pdist(centre).min() for centre in centres])
    closed = closed_exact(points[choice], normals[choice], problem.friction)
    wanted = choice[closed & (sides > problem.separation)][:12]
    assert len(wanted) >= 5
    first = points[wanted].flatten()
    assert torch.equal(drawn(1, problem.separation)[: len(first)], first)


def test_starts_of_a_low_thing_on_a_table_are_drawn_where_a_contact_can_push_level(ellipsoid):
    """A cap of 9 mm on a table: nearly all candidates lie on its top, where none can push level."""
    low = dataclasses.replace(ellipsoid, axes=(1.0, 0.5, 0.15), doubt=0.0)
    foot = low.center[2] - low.scale * low.axes[2]
    spec = ContactSpec(table=foot, friction=0.8, friction_margin=0.75, flat_radius=0.001)
    settled = settle_flatness(low, spec, 0)
    assert settled.level is not None
    points, normals = settled.level
    assert float(low.value(points).abs().max()) < 1e-4
    assert float(normals[:, 2].max()) < math.sin(math.atan(0.6) + math.radians(5))
    tips = low.metres(points) + spec.fingertip_radius * normals
    assert float(tips[:, 2].min()) > foot + spec.fingertip_radius

    def share_closed(candidates: FlatCandidates) -> float:
        first = next(drawn_starts(low, candidates, [200], 0))
        problem = ContactProblem.of(low, spec)
        _, gradient = low.mean_and_gradient(first.flatten(0, 1))
        closed = closed_exact(first, unit(gradient).view_as(first), problem.friction)
        return float(closed.double().mean())

    assert share_closed(settled._replace(level=None)) < 0.05
    assert share_closed(settled) > 0.5
    plan = plan_contacts(low, spec, starts=200)
    good = plan[plan.status == Status.OK]
    assert len(good) > 100 and bool(certify(good.contacts, spec).closed.all())
    high = dataclasses.replace(low, axes=(1.0, 0.6, 0.5))
    assert settle_flatness(high, ContactSpec(table=foot - 0.021), 0).level is None


def test_contacts_on_opposite_sides_of_a_thin_thing_may_be_as_near_as_it_is_thin(ellipsoid):
    plate = dataclasses.replace(ellipsoid, axes=(1.0, 0.8, 0.05), doubt=0.0)
    plan = plan_contacts(plate, ContactSpec(), starts=100)
    good = plan.contacts[plan.status == Status.OK]
    assert len(good) >= 5
    apart = torch.linalg.vector_norm(good.points - good.points.roll(1, 1), dim=-1).amin(-1)
    assert float(apart.min()) < 0.012
    beside = (good.normals[:, :, 2] > 0) == (good.normals.roll(1, 1)[:, :, 2] > 0)
    sides = torch.linalg.vector_norm(good.points - good.points.roll(1, 1), dim=-1)
    assert float(sides[beside].min()) > 0.024  # tips on the same side, whose normals hardly differ


def test_an_impossible_problem_names_the_constraint(ellipsoid):
    doubtful = dataclasses.replace(ellipsoid, doubt=10.0)
    plan = plan_contacts(doubtful, ContactSpec.paper(), starts=10)
    assert set(plan.status.tolist()) == {int(Status.TOO_UNCERTAIN)}
    for spec in (ContactSpec(table=0.6), ContactSpec.paper(friction=0.0)):
        assert not bool((plan_contacts(ellipsoid, spec, starts=10).status == Status.OK).any())


def test_statuses_name_the_first_violation_in_order(ellipsoid):
    around = spokes(0.0, 2.1, 4.2)[0] * real([1.0, 0.6, 1.0])
    spec = ContactSpec(friction_margin=1.0, flatness=None)
    seen = dataclasses.replace(ellipsoid, doubt=1e-4)

    def status(points: torch.Tensor, spec: ContactSpec = spec, shape=seen) -> Status:
        return Status(
            int(check_feasibility(shape, ContactProblem.of(shape, spec), points[None]).status[0])
        )

    assert status(around) is Status.OK
    assert status(around * 1.4) is Status.OUT_OF_DOMAIN
    assert status(around * torch.nan) is Status.OUT_OF_DOMAIN
    assert status(around * 1.001) is Status.OFF_SURFACE
    assert status(around, shape=ellipsoid) is Status.TOO_UNCERTAIN
    assert status(around, dataclasses.replace(spec, table=0.5)) is Status.BELOW_TABLE
    assert status(around, dataclasses.replace(spec, separation=0.12)) is Status.TOO_CLOSE
    touching = around[[0, 0, 1]]
    assert status(touching) is Status.TOO_CLOSE
    assert status(touching, dataclasses.replace(spec, separation=0.0)) is Status.DEGENERATE
    assert status(around, dataclasses.replace(spec, flatness=0.1)) is Status.NOT_FLAT
    close = project(seen, real([[[1.0, 0, 0], [0.8, 0.4, 0], [0.8, -0.4, 0]]]), 8)[0]
    assert (
        status(close, dataclasses.replace(spec, friction=0.3, separation=0.01)) is Status.NOT_CLOSED
    )
    good = {
        Status.OFF_SURFACE: torch.tensor([True, False, True, False]),
        Status.NOT_CLOSED: torch.tensor([True, True, False, False]),
    }
    assert first_violation(good).tolist() == [
        Status.OK,
        Status.OFF_SURFACE,
        Status.NOT_CLOSED,
        Status.OFF_SURFACE,
    ]


def test_bad_arguments_are_refused(ellipsoid):
    wrong = (BadArgument, TypeError)  # TypeError: the annotations are checked in tests
    for name, bad in (
        ("shape", None),
        ("spec", 0.8),
        ("starts", 0),
        ("starts", -3),
        ("starts", True),
        ("time_budget", 0.0),
        ("time_budget", float("nan")),
        ("seed", -1),
        ("seed", 1.5),
    ):
        with pytest.raises(wrong, match=name):
            plan_contacts(**{"shape": ellipsoid, "starts": 3, name: bad})
    far = torch.zeros(2, 3, 3, dtype=torch.float64)
    far[1, 2, 0] = 3.0
    for starts, match in (
        (far, r"starts: .* from the shape's centre"),
        (far * torch.nan, "finite"),
        (torch.zeros(2, 4, 3, dtype=torch.float64), r"starts: expected .*got 4 contacts a row"),
    ):
        with pytest.raises(BadArgument, match=match):
            plan_contacts(ellipsoid, starts=starts)
    with pytest.raises(BadArgument, match="start_radius"):
        plan_contacts(dataclasses.replace(ellipsoid, domain_radius=0.5))
