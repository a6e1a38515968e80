"""Evaluations: what is counted, what is refused, and the same bits however many processes share the
work.
"""

import dataclasses
import json
import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from tests.pinch import QUICK, cylinder, pinch
from tests.scores import GOOD, SCORES, STUCK
from torchgrasp import TrialSpec, load_grasps, load_hand
from torchgrasp.app import cli
from torchgrasp.control import ClosingOptions
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.evaluation import PROTOCOLS, GraspTrial, PoseNoise, Protocol, Truth, evaluate, views
from torchgrasp.evaluation.pull import run_protocol
from torchgrasp.evaluation.summary import STAGES, summarise
from torchgrasp.evaluation.views import EvaluationSpec, choose_rows
from torchgrasp.files import hold_folder
from torchgrasp.foundation.errors import BadArgument, Status

FAMILIES = ((0, "round", "solid"), (1, "round", "solid"), (2, "round", "thin"), (3, "wire", "thin"))
"""Row of `SCORES`, family and group."""


def test_shares_count_every_view_groups_and_families_and_failures_their_one_stage():
    found = summarise(SCORES)
    assert (
        found["gsr"][::3] == (1 / 4, 4)
        and found["top1"][::3] == (1 / 4, 4)
        and found["objects"][::3] == (1 / 3, 3)
    )
    assert found["refused"] == 2 and found["force_n"] == 4.0 and found["plan_cpu_s"] == 3.0
    assert found["overlap_mm"] == pytest.approx(3.0) and found["overlap_mm_max"] == 4.0
    assert found["cpu_s"] == 9.0 + 3.0 and found["executable"] == 10
    assert found["failures"] == {
        "planning": {"OBJECT_COLLISION": 1, "BAD_OBJECT": 1},
        "start": {"START_OVERLAP": 1},
        "pulling or lifting": {"MOVED": 1},
        "simulation": {"TIMED_OUT": 1},
    }
    assert (
        found["by_object"]["tin"]["gsr"][::3] == (0.5, 2)
        and found["by_object"]["tin"]["refused"] == 1
    )
    noisy = [
        dataclasses.replace(SCORES[0], attempts=(GOOD, dataclasses.replace(STUCK, draw=1))),
        SCORES[1],
    ]
    assert summarise(noisy)["top1"][::3] == (1 / 4, 4)  # two draws each, of the refused view too
    scores = [
        dataclasses.replace(SCORES[k], family=family, group=group) for k, family, group in FAMILIES
    ]
    found = summarise(scores)
    assert found["by_group"].keys() == {"solid", "thin"}
    assert found["by_group"]["solid"]["top1"][::3] == (1 / 2, 2)
    assert found["objects"].units == 2 and found["gsr"].units == 1
    stages = [status for reasons in STAGES.values() for status in reasons]
    assert sorted(stages) == [
        s
        for s in Status
        if s >= Status.START_OVERLAP and s not in (Status.BAD_OBJECT, Status.BROKEN)
    ]


def test_spread_rows_reach_from_the_best_to_the_worst():
    for n in range(1, 30):
        rows = choose_rows(n, 6, "spread")
        assert len(set(rows)) == len(rows) == min(n, 6) and rows == sorted(rows)
        assert rows[0] == 0 and rows[-1] == n - 1
        assert choose_rows(n, 6, "best") == list(range(min(n, 6)))
    assert choose_rows(9, 1, "spread") == [0] and choose_rows(0, 3, "spread") == []


def test_bad_protocols_and_specs_are_named_before_any_work():
    hand = load_hand("allegro")
    for name, protocol in PROTOCOLS.items():
        assert protocol.name == name
    for changes, named in (({"force": -1.0}, "force"), ({"density": 0.0}, "density")):
        with pytest.raises(BadArgument, match=rf"{named}: expected .*got"):
            PROTOCOLS["multidex"].with_trial(**changes)
    with pytest.raises(BadArgument, match=r"protocol: expected .*got"):
        evaluate(Path("nowhere"), hand, "best")
    with pytest.raises(BadArgument, match=r"objects: expected .*got"):
        evaluate(Path("nowhere"), hand)
    # workers read the hand's files
    narrow = dataclasses.replace(hand.actuated, upper=0.5 * hand.upper)
    with pytest.raises(BadArgument, match=r"hand: expected .*got"):
        evaluate(Path("nowhere"), dataclasses.replace(hand, actuated=narrow))
    with pytest.raises(BadArgument, match=r"grasps: expected .*got"):
        EvaluationSpec(grasps=0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A tin seen from one side, and another whose mesh is open."""
    path = tmp_path_factory.mktemp("objects")
    tin = trimesh.creation.cylinder(radius=0.03, height=0.12, sections=64)
    tin.apply_translation([0, 0, 0.06])
    rng = np.random.default_rng(0)
    angle = (rng.random(700) - 0.5) * 2.9
    height = 0.12 * rng.random(700)
    seen = np.stack([0.03 * np.cos(angle), 0.03 * np.sin(angle), height], -1)
    pose = np.eye(4)
    pose[:3, 3] = [0.45, 0.0, 0.15]
    for name, mesh in (("tin", tin), ("torn", trimesh.Trimesh(tin.vertices, tin.faces[:-9]))):
        (path / name).mkdir()
        mesh.export(path / name / "mesh.ply")
        trimesh.PointCloud(seen).export(path / name / "view0_noisy.ply")
    entry = {"views": {"view0": {"T_object_camera": pose.tolist()}}}
    (path / "manifest.json").write_text(json.dumps({"objects": {"tin": entry, "torn": entry}}))
    return path


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
def test_any_number_of_workers_gives_the_same_bits_and_a_bad_object_is_refused(folder, tmp_path):
    pytest.importorskip("sapien"), pytest.importorskip("pebble")
    hand = load_hand("barrett")
    noise = PoseNoise(0.002, 0.02, draws=2)
    # without an approach, a trial is shorter
    quick = Protocol("quick", dataclasses.replace(QUICK, approach=0.0), noise=noise)
    spec = EvaluationSpec(2, "spread", starts=4)
    one, two = (
        list(evaluate(folder, hand, quick, spec, workers=n, folder=tmp_path)) for n in (0, 2)
    )
    assert without_times(one) == without_times(two)
    tin, torn = one
    assert [(a.rank, a.draw) for a in tin.attempts] == [
        (r, d) for r in (0, tin.executable - 1) for d in (0, 1)
    ]
    assert (torn.executable, torn.refusal, torn.attempts) == (
        0,
        Status.BAD_OBJECT,
        (),
    ) and "open surface" in torn.note
    assert len(load_grasps(tmp_path / "tin" / "view0.safetensors")) == tin.executable
    planned = dataclasses.replace(spec, grasps=1, planned=True)  # the best alone
    again = list(evaluate(folder, hand, quick, planned, folder=tmp_path))
    assert without_times(again) == without_times(
        [dataclasses.replace(tin, attempts=tin.attempts[:2]), torn]
    )
    other = next(evaluate(folder, load_hand("allegro"), quick, planned, folder=tmp_path))
    assert other.refusal is Status.BAD_OBJECT and "another cloud or hand" in other.note
    path = tmp_path / "tin" / "view0.safetensors"
    found = load_grasps(path)
    codes = found.status.index_fill(0, torch.tensor(0), int(Status.OBJECT_COLLISION))
    dataclasses.replace(found, status=codes).save(path)
    mixed = next(evaluate(folder, hand, quick, planned, folder=tmp_path))
    assert (mixed.executable, mixed.attempts) == (0, ()) and "OBJECT_COLLISION" in mixed.note


def test_a_view_without_grasps_is_refused_for_what_failed_most_often(folder):
    grasp = load_shipped_grasp("cylinder", "barrett")
    failed = grasp[[0, 0, 0, 0, 0]]
    codes = [Status.TIP_ERROR] * 2 + [Status.OBJECT_COLLISION] * 3
    failed = dataclasses.replace(failed, status=torch.tensor([int(code) for code in codes]))
    view = views.ObjectView(folder, "tin", "view0", load_hand("barrett").source)
    spec = EvaluationSpec(1)
    found = views.plan_view(view, PROTOCOLS["dexgraspbench"], spec, failed).score
    assert (found.executable, found.refusal) == (0, Status.OBJECT_COLLISION)
    mixed = dataclasses.replace(failed, status=failed.status.index_fill(0, torch.tensor(4), 0))
    found = views.plan_view(view, PROTOCOLS["dexgraspbench"], spec, mixed).score
    assert (found.executable, found.refusal) == (1, Status.OK)


def test_a_second_run_on_the_folder_is_refused_and_a_bad_input_leaves_none(tmp_path, capsys):
    words = [
        "evaluate",
        "--objects",
        str(tmp_path / "none"),
        "--hand",
        "allegro",
        "--out",
        str(tmp_path / "out"),
    ]
    with hold_folder(tmp_path / "out"):
        assert cli.main(words) == 2
        assert capsys.readouterr().err.startswith("torchgrasp: --out: expected")
    assert cli.main(words) == 2
    assert capsys.readouterr().err.startswith("torchgrasp: --objects: expected")
    assert list(tmp_path.iterdir()) == []


def without_times(scores):
    rows = [dataclasses.replace(x, seconds=0.0, attempts=()) for x in scores]
    return str(
        [rows, *(dataclasses.replace(a, seconds=0.0) for x in scores for a in x.attempts)]
    )  # NaN is not NaN


@pytest.mark.filterwarnings("ignore")
def test_grasps_of_an_earlier_call_keep_the_reason_why_there_are_none(folder, tmp_path):
    smooth = Protocol("smooth", TrialSpec(friction=0.0))
    spec = EvaluationSpec(1, starts=5, only=("tin",))
    (score,) = evaluate(folder, load_hand("barrett"), smooth, spec, folder=tmp_path)
    assert score.executable == 0 and score.refusal is not Status.OK
    (again,) = evaluate(
        folder,
        load_hand("barrett"),
        smooth,
        dataclasses.replace(spec, planned=True),
        folder=tmp_path,
    )
    assert again.refusal is score.refusal and summarise([again])["failures"] == {
        "planning": {score.refusal.name: 1}
    }


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
def test_each_view_is_grasped_with_the_fingers_that_were_chosen_for_it(
    folder, tmp_path, monkeypatch, few_postures
):
    """Here most fingers always win, which are others than the hand's own; later trials find them by
    the files.
    """
    pytest.importorskip("sapien")
    monkeypatch.setattr(
        "torchgrasp.planner.run.expected_success", lambda grasps: grasps.contacts.points.shape[1]
    )
    test = PROTOCOLS["dexgraspbench"]
    test = dataclasses.replace(test, pull=dataclasses.replace(test.pull, seconds=0.2))
    spec = EvaluationSpec(1, starts=3, only=("tin",), fingers="auto")
    (score,) = evaluate(folder, load_hand("allegro"), test, spec, folder=tmp_path)
    assert score.fingers == "index,middle,ring,thumb" and len(score.attempts) == 1
    assert score.attempts[0].force > 1.0 and score.attempts[0].status in (Status.OK, Status.MOVED)
    assert summarise([score, SCORES[0]])["fingers"] == {score.fingers: 1, "": 1}
    (again,) = evaluate(
        folder, load_hand("allegro"), test, dataclasses.replace(spec, planned=True), folder=tmp_path
    )
    assert without_times([again]) == without_times([score])


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
def test_a_pinched_cylinder_is_lifted():
    pytest.importorskip("sapien")
    hand, grasp = pinch("allegro")
    trial = GraspTrial(hand, grasp, Truth(cylinder(), [cylinder()]))
    began = time.process_time()
    found = run_protocol(trial, Protocol("quick", QUICK))
    assert 0 < found.seconds <= time.process_time() - began
    assert found.passed and found.status is Status.OK and found.force > 1.0 and found.moved < 0.01
    assert 0.0 <= found.overlap < 0.003


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
def test_the_command_writes_numbers_and_a_page(folder, tmp_path, capsys, monkeypatch):
    pytest.importorskip("sapien"), pytest.importorskip("pebble")
    bench = PROTOCOLS["dexgraspbench"]
    short = dataclasses.replace(bench, pull=dataclasses.replace(bench.pull, seconds=0.2))
    monkeypatch.setitem(PROTOCOLS, "dexgraspbench", short)
    words = [
        "evaluate",
        "--objects",
        str(folder),
        "--hand",
        "barrett",
        "--out",
        str(tmp_path / "out"),
    ]
    words += ["--workers", "0"]
    assert cli.main([*words, "--grasps", "2", "--starts", "6"]) == 0
    written = json.loads(
        (tmp_path / "out" / "evaluate.json").read_text(), parse_constant=pytest.fail
    )
    assert written["views"][0]["object"] == "tin" and len(written["views"][0]["attempts"]) == 2
    assert (
        written["summary"]["top1"][3] == 2
        and written["asked"]["protocol"]["name"] == "dexgraspbench"
    )
    assert "best-ranked grasps that pass" in capsys.readouterr().out
    page = (tmp_path / "out" / "evaluate.html").read_text()
    assert (
        "<h1>Grasps of the barrett hand under dexgraspbench</h1>" in page and "bad_object" in page
    )
    assert (
        cli.main(
            [
                *words,
                "--grasps",
                "1",
                "--planned",
                str(tmp_path / "out" / "grasps"),
            ]
        )
        == 0
    )


@pytest.mark.parametrize(
    ("changes", "known"),
    [
        ({}, True),
        ({"options": ClosingOptions(attempts=1)}, True),
        ({"options": ClosingOptions(stops=0)}, True),
        ({"options": ClosingOptions(stops=0, attempts=1)}, False),
        ({"closing": "open_loop"}, False),
        ({"table": False, "approach": 0.0}, False),
    ],
)
def test_try_grasp_passes_the_surface_to_closings_that_compare_contacts_with_it(
    folder, monkeypatch, changes, known
):
    tried = []

    def run(trial, protocol, *at):
        tried.append(trial)
        return GOOD

    monkeypatch.setattr(views, "run_protocol", run)
    hand = load_hand("allegro")
    grasp = load_shipped_grasp("jug", "allegro")
    view = views.ObjectView(folder, "tin", "view0", hand.source)
    views.try_grasp(view, grasp, Protocol("quick", TrialSpec(**changes)), EvaluationSpec(1), (0, 0))
    (trial,) = tried
    assert (trial.surface is not None) is known
    if known:  # the tin's axis is inside, what is 3 cm beside its wall is not
        inside, outside = trial.surface.query(torch.tensor([[0.0, 0, 0.06], [0.06, 0, 0.06]]))[0]
        assert inside < -0.02 and outside > 0.02


@pytest.mark.parametrize(("tries", "count"), [(1, 1), (3, 3)])
def test_a_protocol_of_several_tries_has_the_other_grasps_of_the_view(
    folder, monkeypatch, tries, count
):
    """Both in `evaluate` and in a campaign, which share `try_grasp`; the chosen grasp comes first."""
    tried = []

    def run(trial, protocol, *at):
        tried.append(trial.grasp)
        return GOOD

    monkeypatch.setattr(views, "run_protocol", run)
    hand = load_hand("allegro")
    shipped = load_shipped_grasp("jug", "allegro")
    grasps = shipped[torch.tensor([0, 0, 0])]
    scores = torch.tensor([0.3, 0.2, 0.1], dtype=torch.float64)
    grasps = dataclasses.replace(grasps, score=scores)
    protocol = dataclasses.replace(Protocol("quick", QUICK), tries=tries)
    view = views.ObjectView(folder, "tin", "view0", hand.source)
    views.try_grasp(view, grasps, protocol, EvaluationSpec(1), (1, 0))
    assert tried[0].score.tolist() == pytest.approx([0.2, 0.3, 0.1][:count])


def test_objects_of_the_household_protocol_have_the_masses_of_the_manifest(
    folder, tmp_path, monkeypatch
):
    """A mass that the user asks for replaces them, and the density of another protocol."""
    tried = []

    def run(trial, protocol, *at):
        tried.append(protocol.trial)
        return GOOD

    monkeypatch.setattr(views, "run_protocol", run)
    shutil.copytree(folder, tmp_path / "objects")
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["objects"]["tin"]["mass_kg"] = 0.7
    (tmp_path / "objects" / "manifest.json").write_text(json.dumps(manifest))
    hand = load_hand("allegro")
    grasp = load_shipped_grasp("jug", "allegro")
    view = views.ObjectView(tmp_path / "objects", "tin", "view0", hand.source)
    household = PROTOCOLS["household"]
    asked = (household, household.with_trial(mass=0.2), PROTOCOLS["tabletop"])
    for protocol in asked:
        protocol = protocol.with_trial(closing="open_loop")  # which needs no surface
        views.try_grasp(view, grasp, protocol, EvaluationSpec(1), (0, 0))
    assert [trial.mass for trial in tried] == [0.7, 0.2, 0.1]
    assert PROTOCOLS["multidex"].with_trial(mass=0.2).trial.density is None
    assert PROTOCOLS["multidex"].with_trial(friction=0.2).trial.density == 500.0


def test_an_object_whose_mass_no_trial_takes_is_refused_before_it_is_planned(folder, tmp_path):
    """A mass in grams would end the evaluation of all objects at the first trial of this one."""
    objects = tmp_path / "objects"
    shutil.copytree(folder, objects)
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["objects"]["tin"]["mass_kg"] = 250
    (objects / "manifest.json").write_text(json.dumps(manifest))
    view = views.ObjectView(objects, "tin", "view0", load_hand("barrett").source)
    household = PROTOCOLS["household"]
    score, cloud, grasps = views.plan_view(view, household, EvaluationSpec(1))
    assert score.refusal is Status.BAD_OBJECT and cloud is None and grasps is None
    assert "mass_kg: expected 0.001 to 10 kg for 'household', got 250" in score.note
    # a protocol of another mass does not ask
    assert views._of_object(view, PROTOCOLS["tabletop"]) is PROTOCOLS["tabletop"]


def test_a_mesh_that_changes_between_two_calls_is_read_again(folder, tmp_path):
    objects = tmp_path / "objects"
    shutil.copytree(folder, objects)
    before, _ = views._read_solid(objects, "tin")
    again, _ = views._read_solid(objects, "tin")
    assert again is before
    wider = before.copy().apply_scale([1.1, 1.1, 1.0])
    wider.export(objects / "tin" / "mesh.ply")
    os.utime(objects / "tin" / "mesh.ply", (1e9, 1e9))
    after, _ = views._read_solid(objects, "tin")
    assert after.volume > 1.2 * before.volume
