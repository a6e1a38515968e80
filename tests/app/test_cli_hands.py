"""`torchgrasp hand`: a draft, every fault by name, a picture of a sound hand."""

import importlib.util
import io
import json
import re
import shutil
import sys

import numpy as np
import pytest
from PIL import Image

from torchgrasp.app.cli import main
from torchgrasp.app.cli.hands import HandTrial
from torchgrasp.hand.load import hands_folder, load_hand


@pytest.fixture
def barrett(tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    for file in ("hand.urdf", "hand.toml"):
        shutil.copy(hands_folder() / "barrett" / file, folder)
    return folder


@pytest.fixture(autouse=True)
def few_starts(monkeypatch, few_postures, few_draws):
    """Try a hand with little work."""
    monkeypatch.setattr("torchgrasp.app.cli.hands.TRIAL", HandTrial(starts=4, postures=1000))


def test_new_writes_a_draft_that_check_takes_and_draws(barrett, capsys, monkeypatch):
    monkeypatch.setattr("torchgrasp.app.cli.hands._try_objects", lambda hand, bar: True)
    (barrett / "hand.toml").unlink()
    assert main(["hand", "new", str(barrett / "hand.urdf"), "--name", "mine"]) == 0
    assert "CHECK" in capsys.readouterr().out
    picture = barrett / "hand.png"
    assert main(["hand", "check", str(barrett), "--out", str(picture)]) == 0
    said = capsys.readouterr().out
    assert re.search(r"sets of fingers:\ndefault +f1, f2, f3\n", said)
    for words in (
        "mine, option default: 4 actuated of 8 joints",
        "spread",
        "f1_distal = 0.3333 f1_flex",
        "none",
    ):
        assert words in said
    known = json.loads((barrett / "abilities.json").read_text())["sets"]
    assert [one["option"] for one in known] == ["default"] and known[0]["width_m"][1] > 0.1
    free = known[0]["free_share"]
    assert f"abilities of default: {free:.1%} of 1000 random postures are free" in said
    assert re.search(r"\nf1 and f2 +0\.\d+ to 0\.\d+ ", said) and "force [N]" in said
    with Image.open(picture) as image:
        assert (
            image.width == 1350 and len(np.unique(np.asarray(image).reshape(-1, 3), axis=0)) > 100
        )
    assert (
        main(["hand", "new", str(barrett / "hand.urdf")]) == 2
    )  # what is there is not overwritten
    assert "exists" in capsys.readouterr().err


def test_check_names_every_fault(barrett, capsys):
    urdf = barrett / "hand.urdf"
    toml = barrett / "hand.toml"
    text = urdf.read_text()
    urdf.write_text(
        text.replace('<mass value="0.6086"/>', '<mass value="0"/>').replace(
            'effort="2"', 'effort="0"'
        )
    )
    toml.write_text(
        toml.read_text().replace('["f3_flex", "f3_distal"]', '["f3_distal", "f3_flex"]')
    )
    assert main(["hand", "check", str(barrett), "--out", str(barrett / "x.png")]) == 2
    lines = capsys.readouterr().out.splitlines()
    assert all(line.startswith("wrong: ") for line in lines)
    for words in ("link palm of mass 0", "joint spread of effort 0", "finger f3 of joints"):
        assert any(words in line for line in lines), words
    assert not (barrett / "x.png").exists()
    toml.write_text("name = 3")
    assert main(["hand", "check", str(barrett)]) == 2
    assert "hand.toml" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["check", "fist"], "allegro"),
        (["check", "barrett", "--fingers", "five"], "--fingers"),
        (["check", "barrett", "--out", "hand.jpg"], "--out"),
        (["new", "none.urdf"], "none.urdf"),
        (["new", "none.urdf", "--seed", "-1"], "--seed"),
    ],
)
def test_bad_arguments_end_with_one_sentence(arguments, word, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["hand", *arguments]) == 2
    said = capsys.readouterr()
    assert word in said.out + said.err
    assert list(tmp_path.iterdir()) == []


def test_a_posture_is_drawn_with_every_finger(barrett):
    import torch

    from torchgrasp import load_hand
    from torchgrasp.app.report.canvas import FINGERS, rgb
    from torchgrasp.app.report.stills import draw_posture

    hand = load_hand(barrett)
    image = Image.open(
        io.BytesIO(
            draw_posture(hand, torch.tensor([0.5, 0.8, 0.8, 0.8]).double(), (1.0, -0.8, 0.5))
        )
    )
    pixels = np.asarray(image).reshape(-1, 3) / 255
    pixels = pixels[np.ptp(pixels, axis=1) > 0.15]
    hue = pixels / np.linalg.norm(pixels, axis=1, keepdims=True)
    for color in FINGERS[: len(hand.finger_names)]:
        wanted = np.array(rgb(color)) / np.linalg.norm(rgb(color))
        assert (hue @ wanted > 0.99).sum() > 300


def test_new_adds_sensor_tips_that_the_file_lacks(claw, run_command, refusal, tmp_path):
    out = tmp_path / "felt"
    words = "hand", "new", claw, "--out", out, "--tip-offset", "0.02", "--tip-radius", "0.009"
    code, said, _ = run_command(*words)
    assert code == 0 and "repaired: sensor tips are added: left_tip 20 mm along (0, 0, 1)" in said
    assert load_hand(out).tip_radius.tolist() == [0.009] * 3
    told = refusal("hand", "new", claw, "--out", tmp_path / "no", "--tip-offset", "0.5")
    assert told.startswith("--tip-offset: ") and not (tmp_path / "no").exists()


def test_new_mends_a_published_urdf_and_leaves_it_as_it_is(claw, capsys, tmp_path, undrawn):
    """A mesh as a tip: the clean copy lies beside the URDF, under another name, or in a folder of
    its own.
    """
    import trimesh

    trimesh.creation.icosphere(3, 0.011).export(claw.parent / "tip.stl")
    published = claw.parent / "hand.urdf"
    text = claw.read_text().replace('<sphere radius="0.011"/>', '<mesh filename="tip.stl"/>')
    published.write_text(text)
    assert main(["hand", "new", str(published)]) == 0
    said = capsys.readouterr().out
    assert "repaired: 3 collision meshes" in said and "hand_clean.urdf" in said
    assert (
        published.read_text() == text
        and "mesh" not in (claw.parent / "hand_clean.urdf").read_text()
    )
    out = tmp_path / "other"
    assert (
        main(
            [
                "hand",
                "new",
                str(published),
                "--out",
                str(out),
                "--tips",
                "left_tip",
                "thumb_tip",
                "right_tip",
            ]
        )
        == 0
    )
    assert sorted(file.name for file in out.iterdir()) == ["hand.toml", "hand.urdf"]
    assert main(["hand", "check", str(out), "--out", str(out / "hand.png")]) == 0
    assert "the hand can grasp" in capsys.readouterr().out


def test_hand_check_prints_warnings_with_their_fixes(claw, capsys, monkeypatch, undrawn):
    """A pad that faces away, and a link that is always in another's way."""
    text = claw.read_text().replace(
        '<box size="0.016 0.02 0.056"/>', '<box size="0.055 0.055 0.056"/>'
    )
    claw.write_text(text)
    assert main(["hand", "new", str(claw)]) == 0
    toml = claw.parent / "hand.toml"
    pad = toml.read_text().split("[[finger]]")[1]
    away = pad.replace("0.866025403784", "-0.866025403784").replace(
        "0.009526279442", "-0.009526279442"
    )
    assert away != pad
    toml.write_text(toml.read_text().replace(pad, away))
    monkeypatch.setattr("torchgrasp.app.cli.hands._try_objects", lambda hand, bar: False)
    main(["hand", "check", str(claw.parent), "--out", str(claw.parent / "hand.png")])
    said = capsys.readouterr().out
    assert "warning: default: only" in said and "warning: default: the pad of left faces" in said


def test_every_set_of_fingers_is_checked_and_tried(tmp_path, capsys, monkeypatch, undrawn):
    """A draft of the Allegro hand has two; a fault of a further one is named, and four fingers are
    described.
    """
    assert (
        main(
            [
                "hand",
                "new",
                str(hands_folder() / "allegro" / "hand.urdf"),
                "--out",
                str(tmp_path / "mine"),
            ]
        )
        == 0
    )
    assert re.search(
        r"default +[\w, ]*thumb\nfour +index, middle, ring, thumb\n", capsys.readouterr().out
    )
    words = ["hand", "check", str(tmp_path / "mine"), "--out", str(tmp_path / "hand.png")]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "default on the shipped cylinder: " in said and "four on the shipped cylinder: " in said
    monkeypatch.setattr("torchgrasp.app.cli.hands._try_objects", lambda hand, bar: True)
    assert main([*words, "--fingers", "4"]) == 0
    said = capsys.readouterr().out
    assert "option four: 16 actuated" in said and "16 actuated of 16" in said
    toml = tmp_path / "mine" / "hand.toml"
    other = '\n[options.other]\nfingers = ["index", "ring", "thumb"]\n'
    parked = "parked = {joint_4 = 0, joint_5 = 9, joint_6 = 0, joint_7 = 0}\n"
    toml.write_text(toml.read_text() + other + parked)
    assert main(words) == 2
    assert "wrong: " in (said := capsys.readouterr().out) and "joint_5 at 9" in said


def test_train_learns_a_mixture_that_the_paper_modes_take(claw, capsys):
    from torchgrasp import load_hand, load_mixture

    assert main(["hand", "new", str(claw)]) == 0
    folder = str(claw.parent)
    assert (
        main(["hand", "train", folder, "--n", "3000", "--components", "4", "--held-out", "500"])
        == 0
    )
    assert "4 components" in capsys.readouterr().out
    assert load_mixture(folder).joint_names == load_hand(folder).joint_names
    assert main(["hand", "train", folder, "--held-out", "1"]) == 2
    assert main(["hand", "train", folder, "--out", "x.pt"]) == 2


@pytest.fixture
def described(barrett, tmp_path, monkeypatch):
    """A stand-in for the package robot_descriptions, with one hand."""
    package = tmp_path / "path" / "robot_descriptions"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    here = f"REPOSITORY_PATH = {str(barrett)!r}\n"
    urdf = f"URDF_PATH = URDF_PATH_LEFT = {str(barrett / 'hand.urdf')!r}\n"
    (package / "claw_description.py").write_text(here + urdf)
    (package / "scene_description.py").write_text(here + "XACRO_PATH = 'x.xacro'\n")
    (package / "far_description.py").write_text("raise OSError('no route to host')")
    monkeypatch.syspath_prepend(package.parent)
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    for name in [name for name in sys.modules if name.split(".")[0] == "robot_descriptions"]:
        del sys.modules[name]


@pytest.mark.parametrize("name", ["claw", "claw_description"])
def test_new_takes_the_name_of_a_description(described, capsys, name):
    assert main(["hand", "new", name]) == 0
    said = capsys.readouterr().out
    assert f"written: {name}/hand.toml" in said and f"{name} also has URDF_PATH_LEFT: " in said
    assert load_hand(described / name).dof == 4


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("octopus", "allegro_hand"),
        ("scene", "without a URDF"),
        ("far", "no route to host.*"),
        ("none.urdf", "no file"),
    ],
)
def test_new_names_what_is_wrong_with_a_description(described, capsys, name, words):
    assert main(["hand", "new", name]) == 2
    said = capsys.readouterr().err
    assert said.startswith("torchgrasp") or "URDF" in said or "urdf" in said
    assert re.search(words, said) and not (described / name).exists()


def test_new_without_robot_descriptions_names_the_extra(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main(["hand", "new", "allegro_hand"]) == 2
    assert "pip install 'torchgrasp[robots]'" in capsys.readouterr().err
