"""Constructed cases that lack one thing each: where grasps are lost is counted, and what is missing
is named.
"""

import dataclasses

import pytest
import torch
import trimesh

from tests.make import ball, load_hand, see
from torchgrasp import ContactSpec, PointCloud, Status, explain_empty, load_object
from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.ik.seeds import PostureLibrary
from torchgrasp.planner import explain
from torchgrasp.planner.changes import list_changes
from torchgrasp.planner.explain import ExplainNumbers, Funnel, Losses, order_changes
from torchgrasp.planner.request import Request
from torchgrasp.values.planning import Certificate, ContactPlan, Contacts, Grasps, IKSeeds

TABLE = ContactSpec(table=0.0)
VIEW = load_object("cylinder").view


@pytest.fixture
def first_only(monkeypatch):
    """Try the change alone that comes first."""
    monkeypatch.setattr("torchgrasp.planner.explain.EXPLAIN", ExplainNumbers(trials=1))


def view_of(mesh: trimesh.Trimesh) -> PointCloud:
    """What a camera sees of a mesh that stands on the table."""
    mesh.apply_translation([0, 0, -mesh.bounds[0, 2]])
    return partial_view(mesh, look_at(20.0, 45.0, target=mesh), n=600, noise=False, seed=0)


def told(plan: list[Status], tried: int, grasps: list[Status]) -> Funnel:
    """The funnel of made-up rows."""
    rows = torch.zeros(len(plan), 3, 3)
    k = len(grasps)
    contacts = Contacts(rows, rows)
    one = torch.ones(tried)
    certificate = Certificate(one, one, one, one > 0, torch.zeros(tried, 6))
    some = torch.zeros(k, 3)
    pose = torch.eye(4).repeat(k, 1, 1)
    return Funnel.of(
        ContactPlan(
            contacts, torch.zeros(len(plan), 3, 8), torch.zeros(len(plan)), torch.tensor(plan)
        ),
        certificate,
        IKSeeds(some, pose, torch.arange(k), torch.zeros(k, 3).long(), some[:, 0], some),
        Grasps(
            some,
            some,
            some,
            pose,
            contacts[:k],
            torch.zeros(k, 3).long(),
            some,
            some[:, 0],
            some,
            certificate[:k],
            some[:, 0],
            torch.tensor(grasps, dtype=torch.int64),
        ),
    )


def test_a_funnel_counts_what_each_stage_was_given_and_lost():
    ok = Status.OK
    tip = Status.TIP_ERROR
    flat = Status.NOT_FLAT
    funnel = told(
        [ok] * 7 + [flat] * 2 + [Status.NOT_CLOSED], tried=6, grasps=[tip, tip, Status.PREGRASP, ok]
    )
    assert [(s.given, s.kept) for s in funnel.stages] == [(10, 7), (6, 4), (4, 1)]
    assert all(s.kept + sum(s.lost.values()) == s.given for s in funnel.stages)
    assert list(funnel.stages[0].lost) == [flat, Status.NOT_CLOSED]
    assert funnel.stages[1].lost == {Status.OUT_OF_REACH: 2}
    assert funnel.executable == 1 and funnel.reason is tip and funnel.worst.stage == "grasps"
    assert funnel.share(frozenset({flat, tip})) == pytest.approx(2 / 10 + 2 / 4)
    assert str(funnel).splitlines()[2] == "grasps: 1 of 4 postures (2 tip_error, 1 pregrasp)"


@pytest.mark.parametrize(
    ("plan", "tried", "grasps", "stage", "reason"),
    [
        ([Status.BELOW_TABLE] * 4 + [Status.NOT_FLAT], 0, [], "contacts", Status.BELOW_TABLE),
        ([Status.OK] * 3, 3, [], "postures", Status.OUT_OF_REACH),
        ([Status.OK] * 3, 2, [Status.BURIED] * 2, "grasps", Status.BURIED),
        ([Status.OK] * 3, 3, [Status.OK] * 3, "contacts", Status.OK),
    ],
)
def test_the_stage_that_lost_all_gives_the_reason(plan, tried, grasps, stage, reason):
    funnel = told(plan, tried, grasps)
    assert (funnel.worst.stage, funnel.reason) == (stage, reason)


def test_a_funnel_agrees_with_the_observed_run(run):
    _, grasps, seen = run
    funnel = Funnel.of(seen["plan"], seen["certify"], seen["query"], grasps)
    assert funnel.stages[0].given == 48 and funnel.stages[1].given == len(seen["certify"])
    assert (
        funnel.stages[1].kept == len(grasps)
        and funnel.executable == int((grasps.status == Status.OK).sum()) > 0
    )


def changes(**options) -> dict[str, Request]:
    """The changes of a request on the cylinder, by their words."""
    hand = options.pop("hand", load_hand("allegro"))
    spec = options.pop("spec", TABLE)
    return {
        change.words: change.request
        for change in list_changes(Request(VIEW, hand, spec, 20, 0, **options))
    }


def test_every_change_changes_one_thing():
    for words, task in changes().items():
        fields = [f.name for f in dataclasses.fields(ContactSpec)]
        other = [name for name in fields if getattr(task.spec, name) != getattr(TABLE, name)]
        hand = (
            task.hand.name != "allegro"
            or task.hand.finger_names != load_hand("allegro").finger_names
        )
        assert len(other) + hand == 1, words
        assert task.seed == 0 and task.starts == 20 and task.cloud is VIEW


def test_what_cannot_be_changed_is_not_offered():
    def named(*parts: str, **options) -> list[str]:
        return [words for words in changes(**options) if any(part in words for part in parts)]

    assert not named("fingers=", hand=load_hand("barrett"))  # it declares one set
    assert not named("fingers=", fingers="auto")
    assert named("fingers='four'") and named("fingers='default'", fingers="four")
    assert not named("allegro hand", "_left", "biotac") and named("leap hand")
    assert not named("allegro hand", hand=load_hand("allegro_left"))
    assert not named("friction were", spec=ContactSpec(friction=1.2))
    assert not named(
        "friction_margin", "flatness", spec=ContactSpec(friction_margin=1.0, flatness=None)
    )
    assert not named("friction_margin", spec=ContactSpec(friction=0.0))  # a margin of nothing
    strict = ContactSpec(max_variance=1e-3, flatness=0.1, friction_margin=0.2, separation=0.1)
    assert (
        len(named("=0.03 ", "=0.44 ", "margin=0.5 ", "separation=0.026 ", spec=strict)) == 4
    )  # the usual ones first
    assert named("stood on a table", spec=ContactSpec()) and not named(
        "no table", spec=ContactSpec()
    )
    assert not named("mode") and named("mode='joint'", mode="contact_first")
    assert not named("arm") and named("arm", reachable=lambda poses: poses[:, 0, 0] > 0)
    assert named("tip_radius", hand=load_hand("barrett")) and not named(
        "tip_radius"
    )  # its tips are smaller


@pytest.mark.parametrize(
    ("present", "offered"), [(0.1, [0.4, 0.8]), (0.5, [0.8, 1.2]), (0.6, [1.2]), (0.9, [])]
)
def test_the_next_two_materials_are_offered_whose_friction_is_clearly_higher(present, offered):
    """They are smooth plastic, rubber and soft silicone."""
    offers = changes(spec=ContactSpec(friction=present))
    frictions = [x.spec.friction for words, x in offers.items() if "friction were" in words]
    assert frictions == offered


@pytest.mark.parametrize(
    ("field", "usual", "most"), [("max_variance", 0.05, 0.1), ("flatness", 0.6, 0.9)]
)
def test_a_limit_beyond_the_usual_one_is_relaxed_once_more(field, usual, most):
    """At its largest value hardly any contact is refused, and no change is offered."""

    def offered(value: float) -> list[float]:
        found = changes(spec=ContactSpec(**{field: value}))
        return [getattr(x.spec, field) for words, x in found.items() if f"with {field}=" in words]

    assert offered(usual) == [most]
    assert offered(most) == []


@pytest.mark.parametrize(
    ("plan", "grasps", "first"),
    [
        ([Status.NOT_CLOSED] * 9, [], "fingers"),
        ([Status.TOO_UNCERTAIN] * 9, [], "max_variance"),
        ([Status.NOT_FLAT] * 9, [], "flatness"),
        ([Status.TOO_CLOSE] * 9, [], "separation"),
        ([Status.BELOW_TABLE] * 9, [], "no table"),
        ([Status.OK] * 9, [Status.SELF_COLLISION] * 9, "fingers"),
        ([Status.OK] * 9, [Status.TABLE_COLLISION] * 9, "no table"),
    ],
)
def test_the_change_that_prevents_most_comes_first(plan, grasps, first):
    task = Request(VIEW, load_hand("allegro"), TABLE, 20, 0)
    ordered = order_changes(list_changes(task), told(plan, len(grasps), grasps))
    assert first in ordered[0].words
    assert len(ordered) < len(
        list_changes(task)
    )  # what has to do with none of the losses is left out


def test_a_disc_too_low_needs_its_table_gone_and_an_object_under_another_the_other_taken_first(
    first_only,
):
    disc = view_of(trimesh.creation.cylinder(radius=0.03, height=0.005))
    heard = []
    note = lambda *stage: heard.append(stage)  # noqa: E731
    explanation = explain_empty(disc, load_hand("allegro"), TABLE, starts=8, observer=note)
    told = ("funnel", str(explanation.funnel.worst), explanation.funnel)
    assert heard == [told, ("change", str(explanation.best), explanation.best)]
    assert Status.BELOW_TABLE in explanation.funnel.stages[0].lost
    assert (
        explanation.best is not None
        and "no table" in explanation.best.words
        and not explanation.best.choice
    )
    scene = see((0.0, 0.0, 0.09, 0.06), (0.0, 0.0, 0.07, 0.05, 0.06), half=False).select(1)
    explanation = explain_empty(scene, load_hand("barrett"), starts=8)
    assert explanation.best is not None and "taken away first" in explanation.best.words


def test_fingers_without_a_thumb_are_told_to_take_it(monkeypatch):
    monkeypatch.setattr("torchgrasp.planner.explain.EXPLAIN", ExplainNumbers(trials=2))
    spec = dataclasses.replace(TABLE, flat_radius=0.008)
    explanation = explain_empty(VIEW, load_hand("allegro", "paper_literal"), spec, starts=8)
    assert explanation.funnel.executable == 0 and explanation.best is not None
    assert (
        "fingers='default' (index, middle, thumb)" in explanation.best.words
        and explanation.best.choice
    )
    assert str(explanation.best) in str(explanation) and "tip_error" in str(explanation)


@pytest.fixture
def made_up(monkeypatch):
    """Give each change the count and the expected success that a function of its task says; return
    what was tried.
    """
    tried = []

    def install(world):
        def plan(task: Request, *_, **__):
            count, expected = world(task)
            tried.append(task)
            lost = {} if count else {Status.TIP_ERROR: 5}
            stages = (
                Losses("contacts", "starts", 5, {Status.NOT_CLOSED: 2}),
                Losses("grasps", "postures", 5, lost),
            )
            return (
                Funnel((stages[0], dataclasses.replace(stages[1], given=5 if lost else count))),
                expected,
                None,
            )

        monkeypatch.setattr("torchgrasp.planner.explain.try_request", plan)
        return tried

    return install


def test_the_best_change_wins_a_choice_that_solves_it_ends_the_search_and_grasps_need_none(made_up):
    made_up(
        lambda t: (
            (9, 0.5)
            if t.contact_spec.friction > 1
            else (3, 0.1)
            if len(t.hand.tips) == 4
            else (0, 0.0)
        )
    )
    explanation = explain_empty(VIEW, load_hand("allegro"), TABLE)
    assert [t.executable for t in explanation.trials[:2]] == [9, 3]
    assert explanation.advice.index("friction were 1.2") < explanation.advice.index(
        "fingers='four'"
    )
    tried = made_up(lambda t: (20, 0.95) if t.contact_spec.table is None else (0, 0.0))
    facts = [t.choice for t in explain_empty(VIEW, load_hand("barrett"), TABLE).trials]
    assert facts.count(False) == 1 and facts.count(True) > 0
    tried.clear()
    made_up(lambda t: (20, 0.95) if len(t.hand.tips) == 4 else (0, 0.0))
    explanation = explain_empty(VIEW, load_hand("allegro"), TABLE)
    assert explanation.trials[0].executable == 20 and len(explanation.trials) < 5
    made_up(lambda t: (7, 0.3))
    explanation = explain_empty(VIEW, load_hand("barrett"), TABLE)
    assert explanation.trials == () and "7 of 20 starts" in explanation.advice


def test_more_starts_are_tried_where_nothing_helps_and_then_it_says_so(made_up):
    tried = made_up(lambda t: (0, 0.0))
    explanation = explain_empty(VIEW, load_hand("barrett"), TABLE, starts=80)
    assert (
        explanation.best is None
        and tried[-1].starts == 320
        and {t.starts for t in tried[:-1]} == {20}
    )
    assert explanation.advice.startswith("No single change helps")
    assert Status.TIP_ERROR.sentence in explanation.advice
    made_up(lambda t: (4, 0.2) if t.starts > 300 else (0, 0.0))
    explanation = explain_empty(VIEW, load_hand("barrett"), TABLE, starts=80)
    assert explanation.best is not None and explanation.best.words == "with 320 starts"
    assert explanation.advice.endswith("with 320 starts: 4 executable grasps.")


@pytest.mark.parametrize("fingers", [None, "auto"])
def test_the_work_is_bounded_and_what_the_bound_left_out_is_counted(made_up, fingers):
    tried = made_up(lambda t: (0, 0.0))
    hand = load_hand("allegro")
    explanation = explain_empty(VIEW, hand, TABLE, fingers=fingers)
    funnel = Funnel(
        (Losses("contacts", "starts", 5, {Status.NOT_CLOSED: 2}), explanation.funnel.stages[1])
    )
    listed = order_changes(list_changes(Request(VIEW, hand, TABLE, 20, 0, fingers=fingers)), funnel)
    assert sum(len(t.hands) for t in tried) <= 9 and {t.starts for t in tried} == {20}
    assert len(tried) - 1 == len(explanation.trials) > 0 and explanation.left > 0
    assert (
        len(explanation.trials) + explanation.left == len(listed) + 1
    )  # four times 1000 starts are left out, too
    assert f"({len(explanation.trials)} of {len(listed) + 1} changes tried)" in explanation.advice
    explanation = explain_empty(VIEW, hand, TABLE, fingers=fingers, time_budget=1e-3)
    assert len(explanation.trials) <= 1


def test_a_thing_that_no_hand_holds_is_explained_with_few_plans_and_twice_alike(monkeypatch):
    monkeypatch.setattr("torchgrasp.planner.explain.EXPLAIN", ExplainNumbers(trials=1))
    plans = []
    heard = []
    run = explain.plan_object
    monkeypatch.setattr(
        explain,
        "plan_object",
        lambda objects, *given: plans.append(objects) or run(objects, *given),
    )
    cloud = ball(radius=0.14, centre=(0.0, 0.0, 0.14))
    hand = load_hand("barrett")
    own = PostureLibrary.of(hand)
    note = lambda stage, text, _: heard.append((stage, text, len(plans)))  # noqa: E731
    first, again = (explain_empty(cloud, hand, TABLE, starts=100, observer=note) for _ in range(2))
    assert (
        str(first) == str(again)
        and first.best is None
        and "no single change helps" in str(first).lower()
    )
    assert heard[0][0] == "funnel" and heard[0][2] == 1  # the first answer needs one plan alone
    assert len(plans) <= 2 * 2 * 2 and len(heard) == len(first.trials) + len(again.trials) + 2
    assert all(p.request.starts <= 20 and len(p.library.joints) <= 500 for p in plans)
    assert PostureLibrary.of(hand) is own  # the next plan need not draw it anew
