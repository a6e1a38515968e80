"""What programs get that call the command line: JSON on stdout, words on stderr, and how far a
command is.
"""

import json
import re
import time

import pytest
import torch

from tests.make import HALF, halved
from torchgrasp import cloud_from_depth, load_grasps, load_object
from torchgrasp.app.cli import command
from torchgrasp.app.cli.agent_files import Workplace
from torchgrasp.app.cli.agent_tools import make_tool
from torchgrasp.app.cli.command import StageProgress, make_bar
from torchgrasp.cloud import save_cloud
from torchgrasp.cloud.camera import look_at, render_depth
from torchgrasp.data.shipped import DATA
from torchgrasp.foundation.errors import CloudWarning

QUICK = ("--starts", "8", "--no-report", "--hand", "barrett")


def test_grasp_tells_its_result_as_json_and_its_words_on_stderr(run_command, tmp_path, monkeypatch):
    monkeypatch.setattr("torchgrasp.app.cli.results.ENOUGH", 1.0)  # no grasp is likely enough
    code, out, err = run_command("grasp", "cylinder", *QUICK, "--out", tmp_path, "--json")
    told = json.loads(out)
    best = load_grasps(tmp_path / "grasps.safetensors").best
    assert code == 0 and told["executable"] > 0 and told["verdict"] in err
    assert told["file"] == str(tmp_path / "grasps.safetensors")
    assert told["best"]["success"] == float(best.success)
    assert told["best"]["obj_from_hand_m"] == best.obj_from_hand[0].tolist()
    # all joints by name, the driven ones among them
    assert {"f1_flex", "spread"} <= set(told["best"]["joints_rad"])
    # a second view is asked for, from another side than that of the first
    look = told["look_next"]
    assert look["turn_deg"] > 45 and look["std_after_m"] < look["std_before_m"]
    x, y, z = (row[3] for row in look["obj_from_camera_m"][:3])
    assert f"look next  from ({x:.2f}, {y:.2f}, {z:.2f}) m" in err


def test_quiet_commands_print_json_alone_or_nothing(run_command, tmp_path):
    view = DATA / "jug" / "view.ply"
    assert run_command("cloud", "check", view, "--quiet") == (0, "", "")
    code, out, err = run_command("cloud", "check", view, "--quiet", "--json")
    told = json.loads(out)
    assert (code, err) == (0, "") and told["points"] == 1000 and told["refused"] is False
    code, out, err = run_command("doctor", "--json", "--quiet")
    told = json.loads(out)
    assert code == (0 if told["complete"] else 1) and err == ""
    assert {"torch", "GPU"} <= {part["part"] for part in told["parts"]}
    # an error is told all the same, and is no JSON
    code, out, err = run_command("grasp", "jgu", "--json", "--quiet")
    assert (code, out) == (2, "") and err.startswith("torchgrasp: CLOUD: ")


def test_faults_of_a_hand_are_told_as_json(run_command, tmp_path, toy_hand):
    text = (toy_hand / "hand.toml").read_text()
    (toy_hand / "hand.toml").write_text(text.replace('"palm"', '"wrist"'))
    code, out, err = run_command("hand", "check", toy_hand, "--json", "--out", tmp_path / "a.png")
    told = json.loads(out)
    assert code == 2 and told["able"] is False and "wrist" in told["faults"][0]
    assert told["faults"][0] in err


def test_a_bar_in_a_pipe_tells_n_of_all_and_goes_on_telling(capsys, monkeypatch):
    with make_bar(4, "view", desc="trials") as bar:
        bar.update()
        assert bar.describe().startswith("trials: 1 of 4 views, ")
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(command, "BEAT", 0.001)
    told = ""
    with make_bar(3, "job") as bar:
        bar.update(2)
        while told.count("2 of 3 jobs") < 2:
            time.sleep(0.001)
            told += capsys.readouterr().err
    assert bar.ended is not None and bar.ended.is_set()


@pytest.mark.parametrize("words", [("evaluate",), ("hand", "check"), ("cloud", "check")])
def test_commands_that_programs_call_have_both_options(words, capsys):
    from torchgrasp.app import cli

    with pytest.raises(SystemExit):
        cli.main([*words, "--help"])
    told = capsys.readouterr().out
    assert "--json" in told and "--quiet" in told


@pytest.mark.parametrize("noise", [False, True])
def test_a_simulators_cloud_with_its_table_is_planned_on_and_a_cameras_is_refused(
    noise, run_command, tmp_path
):
    """Oracle: the true labels of the image count the points of the table."""
    pose = look_at(azimuth=30.0, elevation=35.0, target=load_object("cylinder").mesh)
    depth, labels = map(halved, render_depth([load_object("cylinder").mesh], pose, noise=noise))
    body = (labels == 1).double()[None, None]
    around = torch.nn.functional.max_pool2d(body, 21, 1, 10)[0, 0] > 0
    with pytest.warns(CloudWarning, match="of its points lie on the table"):
        cloud = cloud_from_depth(depth, HALF, mask=around, camera_pose=pose)
    save_cloud(cloud, tmp_path / "cloud.npz")
    assert run_command("cloud", "check", tmp_path / "cloud.npz")[0] == int(noise)
    code, out, err = run_command("grasp", tmp_path / "cloud.npz", *QUICK, "--out", tmp_path / "out")
    if noise:
        assert code == 2 and "a table left in" in err
        return
    found = re.search(r"note +(\d+) points of a table without noise are left out: (.*)", out)
    assert code == 0 and found and "0.000 m" in found[2]
    assert abs(int(found[1]) - int((around & (labels == 0)).sum())) < 0.02 * len(cloud)
    # a tool for agents sees the same cloud
    tool = make_tool("check_cloud", {"cloud": "cloud.npz"})
    seen = tool.see(Workplace.at(tmp_path), tmp_path / "cloud.npz")
    assert len(seen.source) == len(cloud) - int(found[1])
    assert any(found[0].removeprefix("note").strip() in note for note in seen.notes)


def test_a_stage_that_runs_again_counts_once(capsys):
    progress = StageProgress("shape", "plan", "report")
    counts = []
    for name in ("shape", "plan", "other", "shape", "plan", "report"):
        progress.end(name, "done")
        counts.append(progress.bar.done)
    assert counts == [1, 2, 2, 2, 2, 3]
    assert capsys.readouterr().out.count("\n") == 6  # each has its line
