"""A first hand.toml for a URDF, and a third hand on its whole way: URDF, hand.toml, model, grasps."""

import pytest
import torch

from tests.hostile.fuzz.mutations import limited
from tests.make import box
from torchgrasp import ContactSpec, certify, fit_mixture, plan_grasps
from torchgrasp.app.author.draft import draft_hand
from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.foundation.errors import BadArgument, HandFileError
from torchgrasp.geometry.frames import apply
from torchgrasp.hand.collision_shapes import (
    collision_pairs,
    draw_postures,
    self_collision_from_urdf,
)
from torchgrasp.hand.hand_toml import read_hand_toml
from torchgrasp.hand.kinematics import tree_from_urdf
from torchgrasp.hand.load import hands_folder, load_hand
from torchgrasp.hand.self_collision import SelfCollision
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.posture_model.sample import sample_configurations
from torchgrasp.testing import check_hand


def drafted(urdf, *tips):
    (urdf.parent / "hand.toml").write_text(draft_hand(urdf, tips))
    return urdf.parent


@pytest.mark.usefixtures("few_draws")
def test_a_draft_for_the_claw_passes_the_law(claw):
    hand = check_hand(drafted(claw))
    assert hand.joint_names == tuple(
        f"{f}_{j}" for f in ("left", "right", "thumb") for j in ("swivel", "bend")
    )
    joints = torch.tensor([[0.1, 0.4, 0.2, 0.5, -0.1, 1.0]], dtype=torch.float64)
    found = hand.expand(joints)
    for finger in ("left", "right", "thumb"):
        torch.testing.assert_close(found[f"{finger}_follow"], -0.7 * found[f"{finger}_bend"] + 0.1)
    assert hand.tips.radius.tolist() == [0.011] * 3
    assert hand.approach.tolist() == [0, 0, 1]
    # hardly bent, each pad looks to the middle of the fingertips
    points, normals = hand.fingertips(torch.tensor([[0.0, 0.1] * 3], dtype=torch.float64))
    assert bool((((points.mean(1, keepdim=True) - points) * normals).sum(-1) > 0).all())


@pytest.mark.parametrize(
    ("name", "tips"),
    [("allegro", ("index_tip", "middle_tip", "thumb_tip", "ring_tip")), ("barrett", ())],
)
def test_a_draft_finds_what_the_shipped_hands_have(tmp_path, name, tips):
    shipped = hands_folder() / name
    (tmp_path / "hand.urdf").write_bytes((shipped / "hand.urdf").read_bytes())
    (tmp_path / "hand.toml").write_text(draft_hand(tmp_path / "hand.urdf", tips))
    ours = read_hand_toml(tmp_path / "hand.toml")
    theirs = read_hand_toml(shipped / "hand.toml")
    assert ours.coupling == theirs.coupling and ours.approach == theirs.approach
    assert [f.joints for f in ours.fingers] == [f.joints for f in theirs.fingers]
    pads = [
        torch.tensor([f.pad.normal for f in spec.fingers], dtype=torch.float64)
        for spec in (ours, theirs)
    ]
    assert float((pads[0] * pads[1]).sum(1).min()) > 0.95
    assert [f.pad.radius for f in ours.fingers] == [f.pad.radius for f in theirs.fingers]
    assert set(map(frozenset, theirs.pairs or ())) <= set(map(frozenset, ours.pairs or ()))
    assert check_hand(tmp_path).joint_names == load_hand(name).joint_names


@pytest.mark.usefixtures("few_draws")
@pytest.mark.parametrize(
    "tip", ['<box size="0.02 0.018 0.03"/>', '<cylinder radius="0.008" length="0.03"/>']
)
def test_a_tip_that_is_not_round_gets_a_pad_on_its_side(claw, tip):
    claw.write_text(claw.read_text().replace('<sphere radius="0.011"/>', tip))
    hand = check_hand(drafted(claw))  # the contact is not inside the tip
    depth = 0.01 if "box" in tip else 0.008
    torch.testing.assert_close(
        hand.tips.contact[0],
        torch.tensor([depth, 0, 0.015 - (0.009 if "box" in tip else 0.008)]).double(),
    )
    assert hand.tips.normal[0].tolist() == [1, 0, 0] and hand.tips.radius[0] == 0
    # what tells whether a tip is in the object reaches its contact and no farther
    cover = hand.collision_spheres
    first = hand.collision_spheres.link_index == hand.tips.index[0]
    reach = (cover.center[first] @ hand.tips.normal[0] + cover.radius[first]).max()
    assert depth - 0.002 < float(reach) <= depth + 1e-9


@pytest.mark.usefixtures("few_draws")
def test_of_four_fingers_those_grasp_that_face_each_other(tmp_path):
    """Allegro's thumb faces its fingers; three fingers beside each other practically never do."""
    (tmp_path / "hand.urdf").write_bytes((hands_folder() / "allegro" / "hand.urdf").read_bytes())
    (tmp_path / "hand.toml").write_text(draft_hand(tmp_path / "hand.urdf"))
    hand = check_hand(tmp_path)
    assert "thumb" in hand.finger_names and hand.dof == 12


def with_more_fingers(claw, *more):
    """Give the claw further fingers like its left and right one, farther out."""
    text = claw.read_text()
    end = "</robot>"
    for name, old, y in more:
        start = text.index(f'<link name="{old}_root">')
        finger = text[
            start : text.index(f'<link name="{ {"left": "right", "right": "thumb"}[old] }_root">')
        ]
        sign = "-" if old == "left" else ""
        finger = finger.replace(f"{old}_", f"{name}_").replace(
            f'xyz="-0.045 {sign}0.03', f'xyz="-0.045 {y}'
        )
        text = text.replace(end, finger + end)
    claw.write_text(text)
    return claw


@pytest.mark.usefixtures("few_draws")
@pytest.mark.parametrize(
    "more", [(("ring", "left", -0.07),), (("ring", "left", -0.07), ("index", "right", 0.07))]
)
def test_a_draft_declares_every_number_of_fingers(claw, more):
    """Each set holds the smaller one, passes the law, and parks the joints of all other fingers."""
    folder = drafted(with_more_fingers(claw, *more))
    spec = read_hand_toml(folder / "hand.toml")
    before = set[str]()
    assert list(spec.options) == ["default", "four", "five"][: 1 + len(more)]
    for count, name in enumerate(spec.options, 3):
        hand = check_hand(folder, name)
        option = spec.options[name]
        names = {finger.name for finger in option.fingers}
        assert len(names) == count and before < names
        idle = [finger for finger in spec.all_fingers if finger.name not in names]
        assert set(option.parked) == {j for f in idle for j in f.joints if not j.endswith("follow")}
        assert hand.dof == 2 * count and load_hand(folder, count).finger_names == hand.finger_names
        assert hand.source.options == tuple(spec.options)
        before = names
    assert "thumb" in {finger.name for finger in spec.fingers}


@pytest.mark.usefixtures("few_draws")
def test_named_tips_are_taken_in_their_order(claw):
    tips = ("thumb_tip", "ring_tip", "left_tip", "right_tip")
    spec = read_hand_toml(
        drafted(with_more_fingers(claw, ("ring", "left", -0.07)), *tips) / "hand.toml", "four"
    )
    assert [f.name for f in spec.options["default"].fingers] == ["thumb", "ring", "left"]
    assert [f.name for f in spec.fingers] == ["thumb", "ring", "left", "right"]
    with pytest.raises(BadArgument, match="three to five"):
        draft_hand(
            claw, ("left_tip", "right_tip", "thumb_tip", "ring_tip", "left_far", "right_far")
        )


def test_what_cannot_be_guessed_is_asked_for(claw, tmp_path):
    for third, words in (((), "left_tip"), (("nose",), "left_tip"), (("base",), "base")):
        with pytest.raises(BadArgument, match=words):
            draft_hand(claw, ("left_tip", "right_tip", *third))
    text = claw.read_text()
    claw.write_text(text[: text.index('<link name="thumb_root">')] + "</robot>")
    with pytest.raises(BadArgument, match="three to five"):
        draft_hand(claw)
    claw.write_text(text)
    frame = '<link name="world"/><joint name="w" type="fixed"><parent link="world"/><child link="base"/></joint>'
    claw.write_text(claw.read_text().replace("</robot>", frame + "</robot>"))
    with pytest.raises(HandFileError, match="hand new"):
        draft_hand(claw)
    with pytest.raises(HandFileError, match="no file"):
        draft_hand(tmp_path / "none.urdf")


def test_more_pairs_of_shapes_than_can_be_tested_are_refused_in_little_memory(claw):
    """210 links have 21,945 pairs; their frames in all postures would take a gigabyte."""
    box = '<collision><geometry><box size="0.01 0.01 0.01"/></geometry></collision>'
    many = "".join(
        f'<link name="x{k}">{box}</link>'
        f'<joint name="jx{k}" type="fixed"><parent link="base"/><child link="x{k}"/></joint>'
        for k in range(210)
    )
    claw.write_text(claw.read_text().replace("</robot>", many + "</robot>"))
    with (
        limited(2**29),
        pytest.raises(HandFileError, match="pairs of shapes to test for collisions"),
    ):
        draft_hand(claw)


def test_links_are_tested_until_they_are_settled(claw, monkeypatch):
    claw.write_text(claw.read_text().replace("</robot>", OVERLAPPING + "</robot>"))
    urdf = read_urdf(claw)
    tested = []
    coupling = {j.name: j.mimic for j in urdf.movable if j.mimic is not None}
    tree = tree_from_urdf(urdf)
    shapes = self_collision_from_urdf(urdf, None)
    apart = shapes.separations(tree.frames(draw_postures(urdf, coupling, 3000, 0)), 0.002)
    # each link has one shape
    near = (apart < 0.002).any(1)
    met = (apart < 0).double().mean(1)
    names = [
        [tree.link_names[int(k)] for k in shapes.link[pair]]
        for pair in shapes.pairs[near & (met <= 0.98)]
    ]

    def count(self, frames, below, real=SelfCollision.separations):
        tested.append(len(self.pairs))
        return real(self, frames, below)

    monkeypatch.setattr(SelfCollision, "separations", count)
    found = collision_pairs(urdf, coupling, n=3000)
    assert (
        tested[0] > tested[-1] + 1
    )  # the two in one place, and links that have met and been apart
    assert found and {frozenset(pair) for pair in found} == {frozenset(pair) for pair in names}
    monkeypatch.setattr("torchgrasp.hand.collision_shapes.HAND_SEPARATIONS", 10_000)
    with pytest.raises(HandFileError, match="separations must be measured"):
        collision_pairs(urdf, coupling, n=3000)


def test_too_many_shapes_in_one_place_are_refused_before_any_is_measured(tmp_path, monkeypatch):
    rods = [
        f'<link name="x{k}"><collision><geometry><box size="0.1 0.004 0.004"/></geometry></collision></link>'
        f'<joint name="jx{k}" type="revolute"><parent link="base"/><child link="x{k}"/>'
        f'<origin rpy="0 0 {0.02 * k}"/><axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/>'
        "</joint>"
        for k in range(150)
    ]
    path = tmp_path / "rods.urdf"
    path.write_text(f'<robot name="rods"><link name="base"/>{"".join(rods)}</robot>')
    urdf = read_urdf(path)
    measured = []
    monkeypatch.setattr(SelfCollision, "separations", lambda *arguments: measured.append(arguments))
    with (
        limited(2**28),
        pytest.raises(HandFileError, match="11175000 separations must be measured"),
    ):
        collision_pairs(urdf, {})
    assert not measured


OVERLAPPING = "".join(
    f'<link name="{name}"><collision><geometry><sphere radius="0.001"/></geometry></collision></link>'
    f'<joint name="to_{name}" type="fixed"><parent link="base"/><child link="{name}"/><origin xyz="1 0 0"/></joint>'
    for name in ("one", "two")
)


@pytest.mark.usefixtures("few_draws")
def test_names_of_the_urdf_cannot_break_the_toml(claw):
    text = claw.read_text().replace("left_", "le&quot;ft # \\_")
    claw.write_text(text)
    assert check_hand(drafted(claw)).joint_names[0] == 'le"ft # \\_swivel'


@pytest.mark.usefixtures("few_draws")
def test_a_third_hand_goes_the_whole_way(claw):
    """From the URDF to a model of its postures and to grasps of a box, each checked again."""
    folder = drafted(claw)
    spec = ContactSpec(table=0.0)
    hand = check_hand(folder)
    done = list[int]()
    samples = sample_configurations(hand, 1000, seed=3, observer=done.append, sampling="grasping")
    assert sum(done) == 1000
    mixture = fit_mixture(samples, components=8, iterations=20)
    mixture.save(folder / "mixture.safetensors")
    assert float((mixture.joints(samples.q) - samples.joints).abs().mean()) < 0.4
    shape = box((0.06, 0.05, 0.09))
    view = partial_view(shape, look_at(20.0, 40.0, target=shape), noise=False)
    found = plan_grasps(view, hand, spec, starts=60, seed=0, mode="contact_first")
    good = found.executable
    assert len(good) >= 1
    hand.check_joints(good.joints)
    centres = apply(good.obj_from_hand, hand.tip_centres(good.joints))
    miss = centres - hand.tips.radius[:, None] * good.contacts.normals - good.contacts.points
    assert float(miss.norm(dim=-1).max()) <= 1e-3
    assert bool((hand.self_clearance(good.joints) >= 0).all()) and bool(
        certify(good.contacts, spec).closed.all()
    )
