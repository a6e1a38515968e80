"""Campaigns in clutter: what is counted, what is refused, and the same scores for any number of workers."""

import dataclasses
import json
import math

import numpy as np
import pytest

from tests.clutter import write_objects
from torchgrasp.app import cli
from torchgrasp.errors import BadArgument, Status
from torchgrasp.evaluation.clutter import ClutterResult
from torchgrasp.evaluation.scenes import ClutterSpec, SceneScore, evaluate_scenes, scene_record, summarise_scenes
from torchgrasp.files import format_json
from torchgrasp.hand.load import load_hand

GOOD = ClutterResult("tin", Status.OK, 0.001, 0, (), 0.0, 0.9, np.zeros((2, 4, 4)), 4.0, 2.0)
LOST = dataclasses.replace(GOOD, status=Status.DROPPED, moved=0.03, toppled=2, early=("neighbour",))
SCORES = [
    SceneScore(0, ("tin", "cup"), (GOOD, LOST, GOOD), (), "", plan_seconds=12.0),
    SceneScore(1, ("tin", "cup"), (LOST,), ("tin", "cup"), "the rest is flat", plan_seconds=4.0),
    SceneScore(2, ("cup", "jug"), (), ("cup", "jug"), "all are flat", plan_seconds=8.0),
    SceneScore(3, (), failure=Status.TIMED_OUT),
]


def test_shares_count_first_tries_every_try_and_every_object():
    found = summarise_scenes(SCORES)
    assert found["lifted"][::3] == (1 / 4, 4) and found["planned"][::3] == (2 / 4, 4)
    assert all(found[name][::3] == (2 / 4, 4) for name in ("moved", "toppled", "early"))
    assert found["cleared"][::3] == (2 / 6, 6) and found["tables_cleared"][::3] == (1 / 4, 4)
    assert found["tries_per_object"] == 2.0
    assert found["failures"] == {"DROPPED": 2, "NO_GRASP": 1, "TIMED_OUT": 1}
    assert found["plan_cpu_s"] == 6.0 and found["trial_cpu_s"] == 2.0
    assert "motion" not in scene_record(SCORES[0])["tries"][0]
    assert math.isnan(summarise_scenes([])["lifted"].value)


def test_what_cannot_be_evaluated_is_refused(tmp_path, capsys):
    hand = load_hand("allegro")
    with pytest.raises(BadArgument, match="mesh"):
        evaluate_scenes(tmp_path, hand, 1)
    with pytest.raises(BadArgument, match="scenes"):
        evaluate_scenes(None, hand, 0)
    for wrong in ({"count": (5, 3)}, {"mask_error": 30}, {"enough": 1.5}, {"count": (0, 3)}):
        with pytest.raises(BadArgument, match=next(iter(wrong))):
            ClutterSpec(**wrong)
    words = ["evaluate", "--hand", "allegro", "--out", str(tmp_path / "out")]
    for more, named in (
        ([], "--objects"),
        (["--scenes", "-1"], "--scenes"),
        (["--scenes", "1", "--count", "4", "2"], "--count"),
        (["--scenes", "1", "--mask-error", "99"], "--mask-error"),
        (["--scenes", "1", "--objects", str(tmp_path)], "--objects"),
    ):
        assert cli.main(words + more) == 2
        assert f"torchgrasp: {named}: " in capsys.readouterr().err


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
def test_scores_do_not_depend_on_workers_and_are_written(tmp_path, capsys):
    pytest.importorskip("sapien")
    pytest.importorskip("pebble")
    objects = write_objects(tmp_path / "objects")
    spec = ClutterSpec((2, 2), 1, starts=30, enough=0.0)
    (score,) = evaluate_scenes(objects, load_hand("allegro"), 1, spec, workers=0)
    words = ["evaluate", "--scenes", "1", "--hand", "allegro", "--out", str(tmp_path / "out"), "--count", "2", "2"]
    words += ["--objects", str(objects), "--starts", "30", "--mask-error", "1", "--enough", "0"]
    assert cli.main(words) == 0  # one worker
    assert "target lifted at the first try" in capsys.readouterr().out
    written = json.loads((tmp_path / "out" / "evaluate.json").read_text(), parse_constant=pytest.fail)
    assert written["asked"]["mask_error"] == 1 and written["asked"]["trial"]["closing"] == "uncertainty"
    (found,), known = written["scenes"], json.loads(format_json(scene_record(score)))
    assert len(found["tries"]) == 1
    for record in (found, known):
        for each in (record, *record["tries"]):
            assert each.pop("plan_seconds") > 0 and each.pop("trial_seconds", 1) > 0
    assert found == known
