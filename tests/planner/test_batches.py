"""Grasps that come in batches: what is yielded stays, and all together are those of one call."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
import torch
import trimesh

from tests.make import load_hand, real, same_bits
from torchgrasp import ContactSpec, Status, load_object, plan_grasps, stream_grasps
from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.contacts.certify import certify
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.foundation.base import join
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import rigid
from torchgrasp.planner.rows import CHOICE, Candidates, Row, choose, join_candidates
from torchgrasp.planner.schedule import SCHEDULE, schedule
from torchgrasp.values.planning import Certificate, Contacts, IKSeeds

SPEC = ContactSpec(table=0.0)
HAND = load_hand("barrett")
VIEW = load_object("cylinder").view


@pytest.fixture(scope="module")
def whole():
    """All grasps of one call with more than enough time, and what an observer heard."""
    heard = []
    note = lambda *stage: heard.append(stage)  # noqa: E731
    return plan_grasps(VIEW, HAND, SPEC, 48, time_budget=1e6, observer=note), heard


@pytest.fixture(scope="module")
def streamed():
    """The same batch by batch, and what an observer heard before the first and after it."""
    heard = []
    stream = stream_grasps(
        VIEW, HAND, SPEC, 48, observer=lambda stage, text, value: heard.append(stage)
    )
    before = heard.copy()
    first = next(stream)
    after = heard.copy()
    return [first, *stream], before, after


@pytest.fixture(scope="module")
def parts(streamed):
    return streamed[0]


def test_the_union_of_the_stream_is_the_batch_call_and_each_batch_is_executable_best_first(
    whole, parts
):
    grasps, _ = whole
    assert len(parts) > 1
    union = join(parts)
    union = union[np.lexsort((-union.certificate.margin.numpy(), -union.score.numpy())).tolist()]
    assert same_bits(union, grasps.executable)
    assert [int(part.meta["starts"]) for part in parts] == [32, 48]
    assert parts[-1].meta == grasps.meta
    for part in parts:
        assert (
            len(part)
            and bool((part.status == Status.OK).all())
            and bool(part.certificate.closed.all())
        )
        assert bool((part.score.diff() <= 0).all())
    points = join(parts).contacts.points.flatten(1)
    assert len(points.unique(dim=0)) == len(points)  # no triple twice


def test_no_batch_is_planned_before_it_is_asked_for(streamed):
    _, before, after = streamed
    assert before == [] and after == ["shape", "batch"]


def test_a_budget_ends_after_the_batch_that_passes_it(parts):
    heard = []
    short = plan_grasps(
        VIEW, HAND, SPEC, 48, time_budget=1e-3, observer=lambda *stage: heard.append(stage)
    )
    assert same_bits(short.executable, parts[0])
    assert short.meta["starts"] == "32"
    stages = {stage: value for stage, _, value in heard}
    assert (
        list(stages) == ["shape", "batch", "plan", "certify", "query", "refine"] and len(heard) == 6
    )
    assert len(stages["plan"]) == 32  # what was not planned has no status
    assert len(short) <= SCHEDULE.first
    for wrong in (0.0, -1.0, float("nan")):
        with pytest.raises(BadArgument, match="time_budget"):
            plan_grasps(VIEW, HAND, SPEC, 20, time_budget=wrong)


def test_an_observer_hears_of_each_batch_and_of_the_stages_of_all(whole):
    grasps, heard = whole
    stages = [stage for stage, _, _ in heard]
    assert stages == ["shape", "batch", "plan", "certify", "query", "refine"]
    values = {stage: value for stage, _, value in heard}
    assert len(values["plan"]) == 48 and bool(values["certify"].closed.all())
    assert int(values["query"].row.max()) == len(values["certify"]) - 1  # rows of all batches
    assert same_bits(values["refine"], grasps)
    batches = [value for stage, _, value in heard if stage == "batch"]
    assert sum(len(batch) for batch in batches) < len(grasps) and len(batches[0]) <= SCHEDULE.first


def test_without_a_grasp_contacts_are_planned_on_smaller_flat_areas():
    plans = []

    def note(stage, text, value):
        plans.extend([value] * (stage == "plan"))

    def none_on_the_widest(poses):
        return torch.full((len(poses),), len(plans) > 1)

    options = {"starts": 8, "observer": note}
    found = plan_grasps(VIEW, HAND, SPEC, reachable=none_on_the_widest, **options)
    widest, narrower = plans
    assert not same_bits(widest, narrower)
    given = dataclasses.replace(SPEC, flat_radius=0.006)
    assert same_bits(found, plan_grasps(VIEW, HAND, given, reachable=none_on_the_widest, **options))
    assert len(plans) == 3 and bool((found.status == Status.OK).any())


def test_a_low_plate_is_grasped_on_its_rim():
    plate = trimesh.creation.box((0.04, 0.08, 0.012))
    plate.apply_translation([0.0, 0.0, 0.006])
    view = partial_view(plate, look_at(60.0, 35.0, target=plate), seed=1)
    hand = load_hand("allegro")
    plans = []
    note = lambda stage, text, value: plans.extend([value] * (stage == "plan"))  # noqa: E731
    found = plan_grasps(view, hand, SPEC, 50, observer=note)
    good = found.executable
    assert len(good) and not bool((plans[0].status == Status.OK).any())
    assert float(good.meta["planned_friction"]) == pytest.approx(
        0.4
    )  # the margin is spent on lower plates alone
    slope = good.contacts.normals[..., 2]
    assert (
        bool(((good.contacts.points[..., 2] + 0.012 * slope) > 0.0119).all())
        and float(slope.amax(1).min()) > 0.0
    )
    assert bool(certify(good.contacts, dataclasses.replace(SPEC, friction_margin=1.0)).closed.all())
    strict = dataclasses.replace(SPEC, flat_radius=0.003)
    assert not bool((plan_grasps(view, hand, strict, 50).status == Status.OK).any())


def test_relaxed_constraints_spend_margins_on_the_rim_alone():
    flat = [spec for spec in ContactSpec().relaxed(0.006, 0.012)]
    assert [spec.flat_radius for spec in flat] == [0.004, 0.003] and not any(
        spec.tip_radius for spec in flat
    )
    rims = list(SPEC.relaxed(0.003, 0.0096))
    assert [spec.friction_margin for spec in rims] == [0.5, 0.75, 1.0] and len(
        {spec.flat_radius for spec in rims}
    ) == 1
    assert [spec.tip_radius for spec in rims] == pytest.approx([0.012, 0.0108, 0.0096])
    assert {
        spec.tip_radius
        for spec in dataclasses.replace(SPEC, tip_radius=0.02).relaxed(0.003, 0.0096)
    } == {0.02}
    for fixed in (dataclasses.replace(SPEC, flat_radius=0.004), ContactSpec.paper(table=0.0)):
        assert not list(fixed.relaxed(0.008, 0.012))


def test_batches_plan_all_starts_and_try_all_rows():
    for starts in [*range(1, 300), 1000, 10_000]:
        for most in (160, 250):
            batches = schedule(starts, most)
            assert sum(batch.starts for batch in batches) == starts
            assert sum(batch.tried for batch in batches) == min(starts, most)
            assert min(batch.tried for batch in batches) >= min(SCHEDULE.first, starts)
            assert all(b.tried >= a.tried for a, b in pairwise(batches))
            assert (
                batches[0].starts >= batches[0].tried
                and min(batch.starts for batch in batches) >= 0
            )


def offer(points, seeds_of, cost, cloud=None):
    """Rows at the given points; row i has the seeds `seeds_of[i]`, each known by its energy."""
    n = len(points)
    nan = torch.full((len(points),), torch.nan, dtype=torch.float64)
    row = torch.tensor([i for i, found in enumerate(seeds_of) for _ in found], dtype=torch.int64)
    energy = real([e for found in seeds_of for e in found])
    g = len(row)
    pose = rigid(
        torch.eye(3, dtype=torch.float64).expand(g, 3, 3), torch.zeros(g, 3, dtype=torch.float64)
    )
    seeds = IKSeeds(
        torch.zeros(g, 4).double(),
        pose,
        row,
        torch.arange(3).repeat(g, 1),
        energy,
        torch.zeros(g, 3),
    )
    certificate = Certificate(
        nan, nan, nan, torch.ones(n, dtype=torch.bool), torch.zeros(n, 6).double()
    )
    contacts = Contacts(points, torch.zeros_like(points))
    seeds = dataclasses.replace(seeds, row=row)
    cloud = torch.zeros(n, dtype=torch.int64) if cloud is None else cloud
    load = torch.zeros(n, 6).double()
    return Candidates.of(contacts, certificate, seeds, load, cost, cloud)


class Offered:
    """Rows that come in parts; each is chosen at most once."""

    def __init__(self, clouds):
        self.clouds = clouds
        self.rows = None
        self.turn = 0

    def add(self, part):
        self.rows = part if self.rows is None else join_candidates([self.rows, part])

    def take(self, most):
        self.turn += 1
        chosen = choose(self.rows, most, self.clouds)
        self.rows = self.rows.begin(chosen, self.turn)
        contacts, _, seeds = self.rows.select(chosen)
        return contacts, seeds, self.rows.cloud[chosen]


def test_the_likeliest_rows_are_taken_once_far_apart_with_their_own_seeds():
    rng = torch.Generator().manual_seed(0)
    points = torch.rand(30, 3, 3, generator=rng, dtype=torch.float64)
    cost = torch.rand(30, generator=rng, dtype=torch.float64)
    cost[4] = torch.inf  # no seed
    seeds_of = [[] if i == 4 else [float(i), i + 0.5] for i in range(30)]
    untried = Offered(1)
    for rows in (range(12), range(12, 30)):
        index = list(rows)
        untried.add(offer(points[index], [seeds_of[i] for i in rows], cost[index]))
    gone = []
    for most in (4, 9, 40):
        contacts, seeds, _ = untried.take(most)
        rows = [int((points == one).flatten(1).all(1).nonzero()) for one in contacts.points]
        left = [i for i in range(30) if i not in gone and i != 4]
        likely = sorted(left, key=lambda i: float(cost[i]))[: CHOICE.likely * most]
        assert set(rows) <= set(likely) and len(rows) == min(most, len(left))
        assert seeds.energy.tolist() == [e for i in rows for e in seeds_of[i]]
        assert seeds.row.tolist() == [k for k in range(len(rows)) for _ in range(2)]
        gone += rows
    assert sorted(gone) == [i for i in range(30) if i != 4]
    assert len(untried.take(5)[0]) == 0


def test_sets_that_do_not_resist_the_task_are_taken_only_where_others_lack():
    points = torch.rand(30, 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    # each third set resists
    cost = torch.arange(30).double() + CHOICE.weak * (torch.arange(30) % 3 > 0)
    for most in (6, 9, 14):
        offered = Offered(1)
        offered.add(offer(points, [[float(i)] for i in range(30)], cost))
        taken = {int(i) for i in offered.take(most)[1].energy}
        strong = {i for i in taken if i % 3 == 0}
        assert len(taken) == most and len(strong) == min(most, 10)
        others = sorted(set(range(30)) - set(range(0, 30, 3)))
        assert taken - strong == set(others[: most - len(strong)])


def test_the_contact_sets_of_several_clouds_are_chosen_at_once_as_those_of_each_alone():
    rng = torch.Generator().manual_seed(4)
    clouds = 3
    points = torch.rand(40, 3, 3, generator=rng, dtype=torch.float64)
    cost = torch.rand(40, generator=rng, dtype=torch.float64)
    # the cloud in the middle has none
    cost[7] = torch.inf
    cloud = torch.randint(clouds - 1, (40,), generator=rng) * 2
    cost[10:34] += CHOICE.weak
    together = Offered(clouds)
    alone = [Offered(1) for _ in range(clouds)]
    together.add(offer(points[:0], [], cost[:0]))
    assert len(together.take(4)[0]) == 0
    for rows in (torch.arange(15), torch.arange(15, 40)):
        together.add(offer(points[rows], [[0.0]] * len(rows), cost[rows], cloud[rows]))
        for k, one in enumerate(alone):
            own = rows[cloud[rows] == k]
            one.add(offer(points[own], [[0.0]] * len(own), cost[own]))
        most = 4 if rows[0] == 0 else 9
        contacts, _, owner = together.take(most)
        expected = [one.take(most)[0].points for one in alone]
        assert torch.equal(contacts.points, torch.cat(expected))
        counts = torch.bincount(owner, minlength=clouds).tolist()
        assert counts == [len(x) for x in expected]


def test_what_happened_to_a_row_is_its_status_and_rows_are_found_in_the_order_of_their_turns():
    points = torch.rand(6, 3, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    rows = offer(points, [[float(i)] for i in range(6)], torch.zeros(6).double())
    assert rows.find(Row.SEEDED).tolist() == list(range(6)) and not len(rows.find(Row.ENDED))
    rows = rows.begin(torch.tensor([4, 5]), 1).begin(torch.tensor([0, 2]), 2)
    tried = torch.tensor([0, 4, 2])
    grasps = load_shipped_grasp("jug", "barrett")[[0, 0, 0]]
    grasps = dataclasses.replace(grasps, score=real([1.0, 2.0, 3.0]))
    status = torch.tensor([Row.STUCK, Row.STUCK, Row.ENDED])
    rows = rows.put(tried, grasps, status)
    assert rows.find(Row.STUCK).tolist() == [4, 0]  # row 4 was tried in the first turn
    assert rows.find(Row.STUCK, torch.tensor([False])).tolist() == []
    assert rows.best(torch.tensor([4, 2])).score.tolist() == [2.0, 3.0]
    again = dataclasses.replace(grasps[:1], score=real([9.0]))
    rows = rows.put(torch.tensor([4]), again, torch.tensor([int(Row.ENDED)]))
    assert rows.best(torch.tensor([4, 0])).score.tolist() == [9.0, 1.0]
    _, _, seeds = rows.select(torch.tensor([5, 1]))
    assert seeds.energy.tolist() == [5.0, 1.0] and seeds.row.tolist() == [0, 1]
