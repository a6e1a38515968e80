"""Which fingers grasp: options, numbers and names; where the others are parked; what is refused."""

import re

import pytest
import torch

from torchgrasp.app.author.draft import draft_hand
from torchgrasp.foundation.errors import BadArgument, HandFileError
from torchgrasp.hand.load import load_hand, with_fingers

FINGER = """
[[finger]]
name = "f{0}"
joints = ["j{0}"]
tip_link = "t{0}"
contact = [0, 0, 0.1]
normal = [0, 0, 1]
tip = "point"
"""


def with_more_fingers(folder, count):
    """Add fingers to the toy hand, each like its third."""
    urdf = (folder / "hand.urdf").read_text()
    toml = (folder / "hand.toml").read_text()
    link = re.search(r"<link name=.t3.*?</link>", urdf)[0]
    joint = re.search(r"<joint name=.j3.*?</joint>", urdf)[0]
    for k in range(4, count + 1):
        more = (
            (link + joint).replace("t3", f"t{k}").replace("j3", f"j{k}").replace("0.03", f"0.0{k}")
        )
        urdf = urdf.replace("</robot>", more + "</robot>")
        toml += FINGER.format(k)
    (folder / "hand.urdf").write_text(urdf)
    return toml


@pytest.mark.parametrize(
    "wanted", ["four", 4, "4", ("index", "middle", "ring", "thumb"), "index,middle,ring,thumb"]
)
def test_an_option_its_number_and_its_fingers_are_the_same_hand(wanted):
    hand = load_hand("allegro", wanted)
    assert hand.source.option == "four" and hand.dof == 16
    assert hand.finger_names == ("index", "middle", "ring", "thumb")
    assert load_hand("allegro", 3).finger_names == load_hand("allegro").finger_names
    hand = load_hand("allegro")
    assert with_fingers(hand, "default") is hand and with_fingers(hand, hand.finger_names) is hand
    four = with_fingers(hand.to(torch.float32), 4)
    assert (
        four.finger_names == ("index", "middle", "ring", "thumb")
        and four.lower.dtype == torch.float32
    )
    assert hand.source.options == ("default", "four", "paper_literal")


def test_an_option_of_the_same_fingers_parks_the_other_joints_elsewhere(toy_hand):
    """Fingers that are chosen by name keep the positions that the hand has."""
    toml = with_more_fingers(toy_hand, 4)
    fingers = 'fingers = ["f1", "f2", "f3"]'
    both = (
        f"{fingers}\nparked = {{ j4 = 0.0 }}\n[options.aside]\n{fingers}\nparked = {{ j4 = 0.3 }}"
    )
    (toy_hand / "hand.toml").write_text(toml.replace(fingers, both))
    hand = load_hand(toy_hand)
    aside = with_fingers(hand, "aside")
    assert aside.source.option == "aside"
    assert torch.equal(aside.actuated.offset, load_hand(toy_hand, "aside").actuated.offset)
    assert not torch.equal(aside.actuated.offset, hand.actuated.offset)
    for back in ("default", 3, "3"):
        assert torch.equal(with_fingers(aside, back).actuated.offset, hand.actuated.offset)
    for same in ("aside", aside.finger_names, "f1,f2,f3"):
        assert with_fingers(aside, same) is aside


def test_each_finger_touches_where_it_does_in_the_options_of_three(generator):
    four = load_hand("allegro", 4)
    share = torch.rand(50, 16, generator=generator, dtype=torch.float64)
    joints = torch.lerp(four.lower, four.upper, share)
    points, normals = four.fingertips(joints)
    for option in ("default", "paper_literal"):
        three = load_hand("allegro", option)
        own = [four.finger_names.index(name) for name in three.finger_names]
        used = [four.joint_names.index(name) for name in three.joint_names]
        for ours, theirs in zip((points, normals), three.fingertips(joints[:, used]), strict=True):
            torch.testing.assert_close(ours[:, own], theirs, rtol=0, atol=1e-12)
        torch.testing.assert_close(
            four.jacobian(joints)[:, own][..., used], three.jacobian(joints[:, used])
        )


def test_other_fingers_are_parked_where_an_option_parks_them_or_straight():
    hand = load_hand("allegro", ("index", "middle", "ring"))
    assert hand.source.option == "paper_literal"
    chosen = load_hand("allegro", "thumb,middle,index")  # in another order than any option's
    assert chosen.source.option == "thumb,middle,index"
    default = dict(
        zip(chosen.tree.joint_names, load_hand("allegro").actuated.offset.tolist(), strict=True)
    )
    parked = dict(zip(chosen.tree.joint_names, chosen.actuated.offset.tolist(), strict=True))
    assert parked == default and parked["joint_11"] == -0.227
    without_index = load_hand("allegro", ("middle", "ring", "thumb"))
    assert without_index.actuated.offset.abs().max() == 0  # no option parks the index finger
    assert bool(
        (
            without_index.self_clearance((without_index.lower + without_index.upper)[None] / 2) > 0
        ).all()
    )


def test_parked_joints_without_zero_in_their_range_stay_at_the_limit_next_to_it(toy_hand):
    toml = with_more_fingers(toy_hand, 5)
    (toy_hand / "hand.toml").write_text(
        toml.replace(
            "[options.default]",
            '[options.all]\nfingers = ["f1","f2","f3","f4","f5"]\n[options.default]',
            1,
        ).replace('"f3"]', '"f3"]\nparked = { j4 = 0.5, j5 = 0.0 }', 1)
    )
    urdf = (toy_hand / "hand.urdf").read_text()
    (toy_hand / "hand.urdf").write_text(
        urdf.replace('lower="-1" upper="1"', 'lower="0.2" upper="1"', 1)
    )
    names = load_hand(toy_hand, "all").tree.joint_names
    offset = load_hand(toy_hand, ("f2", "f3", "f5")).actuated.offset
    assert dict(zip(names, offset.tolist(), strict=True)) == {
        "j1": 0.2,
        "j2": 0.0,
        "j3": 0.0,
        "j4": 0.5,
        "j5": 0.0,
    }
    assert load_hand(toy_hand, 5).dof == 5


@pytest.mark.parametrize(
    "wanted",
    ["three", 2, 5, 6, (), ("index", "thumb"), ("index", "index", "thumb"), "index,,thumb"],
)
def test_fingers_that_a_hand_has_not_are_refused_with_those_that_it_has(wanted):
    with pytest.raises(
        BadArgument, match=r"fingers.*'default', 'four'.*three to five.*'index', 'middle'"
    ):
        load_hand("allegro", wanted)


@pytest.mark.parametrize("count", [2, 6])
def test_a_hand_of_two_or_six_fingers_says_what_is_supported(toy_hand, count):
    toml = with_more_fingers(toy_hand, count)
    names = ", ".join(f'"f{k}"' for k in range(1, count + 1))
    (toy_hand / "hand.toml").write_text(toml.replace('["f1", "f2", "f3"]', f"[{names}]"))
    with pytest.raises(HandFileError, match="three to five different fingers"):
        load_hand(toy_hand)


def test_a_joint_may_follow_a_sum_of_joints(claw):
    """A differential: the middle finger bends by the mean of its neighbours, as a bar pulls it."""
    text = claw.read_text()
    mimic = '<mimic joint="thumb_bend" multiplier="-0.7" offset="0.1"/>'
    assert mimic in text
    claw.write_text(text.replace(mimic, ""))
    toml = claw.parent / "hand.toml"
    row = '"thumb_follow" = { sources = { "left_bend" = 0.25, "right_bend" = -0.5 }, offset = 0.1 }'
    drafted = draft_hand(claw)
    toml.write_text(drafted.replace("[coupling]", f"[coupling]\n{row}"))
    hand = load_hand(claw.parent)
    joints = torch.rand(5, hand.dof, generator=torch.Generator().manual_seed(0)).double()
    found = hand.expand(joints)
    wanted = 0.1 + 0.25 * found["left_bend"] - 0.5 * found["right_bend"]
    torch.testing.assert_close(found["thumb_follow"], wanted)
    # the tip of the thumb moves with the joints of the other fingers
    step = 1e-6 * torch.eye(hand.dof, dtype=torch.float64)
    ahead = hand.fingertips(joints[:1] + step)[0]
    behind = hand.fingertips(joints[:1] - step)[0]
    slope = ((ahead - behind) / 2e-6).permute(1, 2, 0)
    torch.testing.assert_close(hand.jacobian(joints[0]), slope, atol=1e-7, rtol=0)
    for wrong, match in (
        ("sources = { }", "at least one source"),
        ('sources = { "left_follow" = 1.0 }', "not coupled itself"),
        ('sources = { "none" = 1.0 }', "'none'"),
        ('source = "left_bend", sources = { "left_bend" = 1.0 }', "source"),
    ):
        bad = row.replace('sources = { "left_bend" = 0.25, "right_bend" = -0.5 }', wrong)
        toml.write_text(drafted.replace("[coupling]", f"[coupling]\n{bad}"))
        with pytest.raises(HandFileError, match=match):
            load_hand(claw.parent)
