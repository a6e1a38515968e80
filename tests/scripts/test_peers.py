"""scripts/bench.py peers: every planner's grasps get the same verdict, and a missing one no number."""

import json
import sys
from pathlib import Path

import pytest
import torch
from benchmarks.common import Options
from benchmarks.peers import rate
from benchmarks.peers.judge import fit_pose, judge, read_answer
from benchmarks.peers.rate import Thing, list_things, read_commands, run_peer

from tests.make import load_hand
from torchgrasp import load_object
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.export.postures import describe_pose
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply, rigid, rotation_from_vector

FRICTION = 0.6


@pytest.fixture(scope="module")
def jug():
    return load_object("jug")


def answer(*grasps: dict, **changes) -> dict:
    """Return what an adapter of a planner prints."""
    return {
        "fingers": "default",
        "sees": "mesh",
        "settings": "none",
        "versions": {"peer": "1"},
        "tried": 3,
        "seconds": 2.0,
        "joint_names": list(load_hand("allegro").joint_names),
        "grasps": list(grasps),
    } | changes


def held(lift: float = 0.0, bend: float = 0.0) -> dict:
    """Return the shipped grasp of the jug, lifted [m], and bent [rad], as a planner tells it."""
    grasp = load_shipped_grasp("jug", "allegro")
    pose = grasp.obj_from_hand[0].double().clone()
    pose[2, 3] += lift
    told = describe_pose(pose)
    joints = (grasp.joints[0].double() + bend).tolist()
    return {"joints": joints, "pose": [*told["position"], *told["quaternion_wxyz"]]}


def read(folder: Path, content: object):
    """Return the answer that a file holds."""
    path = folder / "answer.json"
    path.write_text(json.dumps(content))
    return read_answer(path)


def test_a_good_grasp_passes_and_bad_ones_are_told_apart(jug, tmp_path):
    given = read(tmp_path, answer(held(), held(lift=0.3), held(lift=-0.05), held(bend=3.0)))
    good, counts = judge(given, jug.mesh, FRICTION)
    assert len(good) == 1 and counts["OK"] == 1 and sum(counts.values()) == 4
    assert counts["JOINT_LIMITS"] == 1 and counts["TIP_ERROR"] >= 1
    shipped = load_shipped_grasp("jug", "allegro")
    assert torch.allclose(good.obj_from_hand, shipped.obj_from_hand.double(), atol=1e-6)
    # its contacts are on the true surface: an independent oracle of distances
    nearest = jug.mesh.nearest.on_surface(good.contacts.points[0].numpy())[1]
    assert nearest.max() < 1e-6


def test_slippery_fingers_do_not_close(jug, tmp_path):
    counts = judge(read(tmp_path, answer(held())), jug.mesh, 0.02).counts
    assert counts == {"NOT_CLOSED": 1}


def test_fingertips_tell_the_pose_and_those_of_another_hand_are_refused(tmp_path):
    hand = load_hand("allegro")
    told = held()
    joints = torch.tensor(told["joints"], dtype=torch.float64)
    pose = rigid(
        rotation_from_vector(torch.tensor([0.3, -0.2, 2.0], dtype=torch.float64)),
        torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64),
    )
    tips = apply(pose, hand.tip_centres(joints))
    found = read(tmp_path, answer({"joints": told["joints"], "tips": tips.tolist()}))
    assert torch.allclose(found.obj_from_hand[0], pose, atol=1e-9)
    assert torch.allclose(fit_pose(tips, tips), torch.eye(4, dtype=torch.float64), atol=1e-9)
    with pytest.raises(BadArgument, match="mm off"):
        read(tmp_path, answer({"joints": told["joints"], "tips": (1.2 * tips).tolist()}))


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        ([], "an object"),
        ({"versions": {}}, "no fingers"),
        (answer(fingers="six"), "default"),
        (answer(joint_names=["joint_0"]), "joint_1"),
        (answer(seconds=-1.0), "seconds"),
        (answer({"joints": [0.0]}), "joints"),
        (answer({"joints": held()["joints"]}), "'pose' or 'tips'"),
        (answer(held() | {"pose": [0.0] * 7}), "length"),
    ],
)
def test_a_broken_answer_is_refused_in_one_sentence(broken, said, tmp_path):
    with pytest.raises(ValueError, match=said) as caught:
        read(tmp_path, broken)
    assert "\n" not in str(caught.value)


def test_planners_that_are_not_installed_get_no_number(monkeypatch):
    monkeypatch.setattr(rate, "read_commands", lambda given: {})
    rows = rate.rate(Options())
    assert [row.what for row in rows] == [peer.what for peer in rate.PEERS.values()]
    foreign = [row for row in rows if row.what in ("FRoGGeR", "SpringGrasp")]
    assert all(row.measured.startswith("not installed: clone ") for row in foreign)
    assert not any(row.numbers for row in rows)


@pytest.mark.parametrize("given", ["frogger", "frogger=/nowhere/python", "someone=/bin/sh"])
def test_a_wrong_option_is_refused(given):
    with pytest.raises(SystemExit, match="peers: "):
        read_commands([given])


def test_an_adapter_runs_as_a_process_and_its_failure_is_the_row(jug, tmp_path):
    own = tmp_path / "own.py"
    content = answer(held(lift=0.3))
    own.write_text(f"print('a word')\nprint({json.dumps(json.dumps(content))})")
    thing = Thing("jug", jug.mesh, jug.parts, jug.view)
    found = run_peer(sys.executable, own, thing, Options())
    assert (found.seconds, found.starts, found.passed, found.tried) == (2.0, 3, 0, 0)
    row = rate.row_of("own", [found])
    assert row.measured.startswith(
        "none passes, 2.000 s for each that it returns; none tried; 0 of 1 grasps pass (1 TIP_ERROR)"
    )
    own.write_text("import sys; sys.exit('no such planner')")
    assert run_peer(sys.executable, own, thing, Options()).failure == "failed: no such planner"
    told = {"told": "3 of 4", "versions": {"peer": "2"}}
    own.write_text(f"print({json.dumps(json.dumps(told))})")
    alone = rate.row_of("own", [run_peer(sys.executable, own, thing, Options())])
    assert alone.measured == "3 of 4 (peer 2)"
    adapter = rate.ADAPTERS / "run_frogger.py"  # its package is not in this environment
    assert "no FRoGGeR" in run_peer(sys.executable, adapter, thing, Options()).failure


def test_objects_are_the_shipped_ones_and_those_of_folders(tin):
    assert [x.name for x in list_things(Options(objects=(tin.parent / "objects",)))] == [
        "cylinder",
        "jug",
        "tin",
    ]
