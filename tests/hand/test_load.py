"""Loading a hand: which hands there are, and hand.toml files that are broken or do not fit their
URDF.
"""

import dataclasses
import re
import shutil

import pytest
import torch

from torchgrasp.foundation.errors import BadArgument, HandFileError
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import check_as_loaded, find_hand, hands_folder, load_hand, with_fingers


def test_a_hand_is_found_by_name_folder_and_file_and_unknown_ones_are_named(tmp_path):
    folder = hands_folder() / "barrett"
    for given in ("barrett", folder, str(folder), folder / "hand.toml"):
        assert find_hand(given) == folder
    assert load_hand(folder).source.sha256 == load_hand("barrett").source.sha256
    with pytest.raises(HandFileError, match=r"allegro.*barrett"):
        load_hand("fist")
    with pytest.raises(HandFileError, match=r"hand\.toml"):
        load_hand(tmp_path)
    with pytest.raises(BadArgument, match="paper_literal"):
        load_hand("allegro", "thumbs")


def test_a_shipped_name_that_is_a_folder_here_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(find_hand("leap"), tmp_path / "leap")
    with pytest.raises(HandFileError, match="a shipped hand and a folder here"):
        find_hand("leap")
    assert find_hand("./leap").resolve() == tmp_path / "leap" == find_hand(tmp_path / "leap")
    monkeypatch.chdir(hands_folder())
    assert find_hand("leap") == hands_folder() / "leap"


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('name = "toy"', "name = 3", "name"),
        ('name = "toy"', 'name = "toy', "TOML"),
        ("kp = 1.0", "kp = nan", "kp"),
        ("kp = 1.0", 'kp = "much"', "kp"),
        ("normal = [0, 0, 1]", "normal = [0, 0, 2]", "unit"),
        ("contact = [0, 0, 0.1]", "contact = [0, 0.1]", "3 numbers"),
        ('urdf = "hand.urdf"', 'urdf = "../hand.urdf"', "beside"),
        ('fingers = ["f1", "f2", "f3"]', 'fingers = ["f1", "f2"]', "three to five different"),
        ('fingers = ["f1", "f2", "f3"]', 'fingers = ["f1", "f2", "f9"]', "three to five different"),
        ('tip_link = "t1"', 'tip_link = "t9"', "'t9'"),
        ('base_link = "palm"', 'base_link = "t1"', "root"),
        ("kd = 0.1", "kd = 0.1\nki = 0.1", "ki"),
        ("kd = 0.1", "kd = 1" + 400 * "0", "kd"),
        ("contact = [0, 0, 0.1]", "contact = [0, 0, true]", "a finite number"),
        ("contact = [0, 0, 0.1]", "contact = [0, 0, 1" + 400 * "0" + "]", "a finite number"),
        ("kd = 0.1", "kd = 1" + 5000 * "0", "TOML"),
        ("kd = 0.1", "kd = 0x" + 5000 * "f", "kd = a huge number"),
        ('urdf = "hand.urdf"', 'urdf = "hand\\u0000.urdf"', "urdf"),
        ('name = "f3"', 'name = "f2"', "f2"),
        ("limit_margin = 0.0", "limit_margin = 1.0", "limit_margin"),
        (
            'fingers = ["f1", "f2", "f3"]',
            'fingers = ["f1", "f2", "f3"]\nparked = { j1 = 0.0 }',
            "j1",
        ),
        (
            "[options.default]",
            "[self_collision]\npairs = [['t1', 't1']]\n[options.default]",
            "pairs",
        ),
    ],
)
def test_broken_hand_toml_is_refused(toy_hand, old, new, match):
    text = (toy_hand / "hand.toml").read_text()
    assert old in text
    load_hand(toy_hand)
    (toy_hand / "hand.toml").write_text(text.replace(old, new))
    with pytest.raises(HandFileError, match=match):
        load_hand(toy_hand)


def test_a_parked_finger_may_be_coupled(toy_hand):
    ball = '<collision><geometry><sphere radius="0.01"/></geometry></collision>'
    body = '<inertial><mass value="0.1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
    more = "".join(
        f'<link name="{child}">{body}{ball}</link><joint name="{name}" type="revolute"><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        for name, parent, child in (("j4", "palm", "t4"), ("j5", "t4", "t5"))
    )
    urdf = toy_hand / "hand.urdf"
    toml = toy_hand / "hand.toml"
    urdf.write_text(urdf.read_text().replace("</robot>", more + "</robot>"))
    old = 'fingers = ["f1", "f2", "f3"]\n'
    new = old + 'parked = {PARK}\n[coupling]\nj5 = { source = "j4", ratio = 0.5, offset = 0.1 }\n'
    text = toml.read_text()
    toml.write_text(text.replace(old, new.replace("{PARK}", "{ j4 = 0.4 }")))
    joints = load_hand(toy_hand).expand(torch.zeros(3, dtype=torch.float64))
    assert float(joints["j4"]) == pytest.approx(0.4)
    assert float(joints["j5"]) == pytest.approx(0.3)
    toml.write_text(text.replace(old, new.replace("{PARK}", "{ j4 = 0.4, j5 = 0.2 }")))
    with pytest.raises(HandFileError, match="j5"):
        load_hand(toy_hand)


@pytest.mark.parametrize(("link", "match"), [("t2", "t2 without"), ("palm", "palm")])
def test_links_that_no_check_could_see_are_refused(toy_hand, link, match):
    text = (toy_hand / "hand.urdf").read_text()
    ball = '<collision><geometry><sphere radius="0.01"/></geometry></collision>'
    start = text.index(f'<link name="{link}">')
    (toy_hand / "hand.urdf").write_text(text[:start] + text[start:].replace(ball, "", 1))
    with pytest.raises(HandFileError, match=match):
        load_hand(toy_hand)


@pytest.mark.parametrize("grams", [60, 400])
def test_masses_in_grams_are_refused(toy_hand, grams):
    urdf = toy_hand / "hand.urdf"
    text = urdf.read_text()
    kilograms = re.sub(r'mass value="[^"]*"', f'mass value="{grams / 1000}"', text)
    assert kilograms != text
    urdf.write_text(kilograms)
    load_hand(toy_hand)
    urdf.write_text(kilograms.replace(f'"{grams / 1000}"', f'"{grams}"'))
    with pytest.raises(HandFileError, match=rf"masses in kg.*in grams.*of {grams} kg"):
        load_hand(toy_hand)


def test_the_toy_hand_turns_its_fingers(toy_hand):
    hand = load_hand(toy_hand)
    points, normals = hand.fingertips(torch.tensor([0.5, 0.0, 0.0], dtype=torch.float64))
    sine = torch.sin(torch.tensor(0.5)).double()
    cosine = torch.cos(torch.tensor(0.5)).double()
    torch.testing.assert_close(
        points[0], torch.stack([0.01 + 0.1 * sine, 0 * sine, 0.1 * cosine]), atol=1e-7, rtol=0
    )
    torch.testing.assert_close(normals[0], torch.stack([sine, 0 * sine, cosine]), atol=1e-7, rtol=0)


def test_a_hand_with_other_numbers_than_its_files_is_not_read_again(toy_hand):
    """What reads the files again would return the old numbers."""

    def narrowed(hand: Hand) -> Hand:
        upper = hand.upper * torch.tensor([0.2, *[1.0] * (hand.dof - 1)]).to(hand.upper)
        return dataclasses.replace(hand, actuated=dataclasses.replace(hand.actuated, upper=upper))

    def weakened(hand: Hand) -> Hand:
        drives = {name: x._replace(effort=x.effort / 2) for name, x in hand.actuators.items()}
        return dataclasses.replace(hand, actuators=drives)

    hand = load_hand("allegro")
    for changed in (narrowed(hand), weakened(hand)):
        with pytest.raises(BadArgument, match=r"hand: expected .*change its files.*allegro"):
            check_as_loaded(changed)
        with pytest.raises(BadArgument, match=r"hand: expected .*change its files.*allegro"):
            with_fingers(changed, "four")
        assert with_fingers(changed, "default") is changed
    # each way to load and move a hand is one of the files
    for other in (load_hand("allegro", "four"), load_hand("allegro", ("thumb", "ring", "index"))):
        for moved in (other, other.to(torch.float32), other.to(torch.float32).to(torch.float64)):
            check_as_loaded(moved)
    assert with_fingers(hand.to(torch.float32), "four").lower.dtype == torch.float32
    toy = load_hand(toy_hand)
    check_as_loaded(toy)
    file = toy_hand / "hand.toml"
    file.write_text(file.read_text() + "# another file\n")
    with pytest.raises(BadArgument, match="change its files"):
        check_as_loaded(toy)
