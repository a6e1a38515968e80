"""The public law for hands: the shipped hands obey it, broken ones are told why they do not."""

from pathlib import Path

import pytest

from torchgrasp.errors import HandFileError
from torchgrasp.hand.load import hands_folder
from torchgrasp.testing import check_hand


@pytest.mark.parametrize(
    ("name", "fingers"), [("allegro", "default"), ("allegro", "paper_literal"), ("barrett", "default")]
)
def test_shipped_hands_obey_the_law(name, fingers):
    assert check_hand(name, fingers).name == name


def copy_of(name: str, tmp_path: Path, file: str, old: str, new: str) -> Path:
    """Copy a shipped hand with the first occurrence of `old` replaced in one of its files."""
    for part in ("hand.urdf", "hand.toml"):
        text = (hands_folder() / name / part).read_text()
        if part == file:
            assert old in text
            text = text.replace(old, new, 1)
        (tmp_path / part).write_text(text)
    return tmp_path


@pytest.mark.parametrize(
    ("name", "file", "old", "new", "match"),
    [
        ("allegro", "hand.urdf", '<mass value="0.4154"/>', '<mass value="0"/>', "mass"),
        ("allegro", "hand.urdf", 'ixx="0.0007501"', 'ixx="0.0107501"', "principal"),
        ("allegro", "hand.urdf", 'effort="0.7"', 'effort="0"', "effort"),
        ("allegro", "hand.toml", "joint_9 = -0.196", "joint_9 = -1.0", "joint_9"),
        ("barrett", "hand.toml", "ratio = 0.3333333333333333", "ratio = 0.3443", "coupling"),
        ("barrett", "hand.toml", '["f3_flex", "f3_distal"]', '["f3_distal", "f3_flex"]', "in order"),
    ],
)
def test_broken_hands_are_told_why(tmp_path, name, file, old, new, match):
    with pytest.raises(HandFileError, match=match):
        check_hand(copy_of(name, tmp_path, file, old, new))


def test_a_hand_of_ones_own_is_accepted(tmp_path):
    folder = copy_of("barrett", tmp_path, "hand.toml", 'name = "barrett"', 'name = "mine"')
    assert check_hand(folder).name == "mine"
