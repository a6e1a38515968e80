"""MJCF hands: our chain is MuJoCo's own, with tendons, equalities, limits and efforts; what cannot
be a hand is refused in one sentence.
"""

import numpy as np
import pytest
import torch

from tests.mjcf_hands import HANDS, motors, tendon_hand
from tests.pinch import QUICK
from torchgrasp import Status, close_hand, load_object, plan_grasps
from torchgrasp.app.author.draft import Draft, Wish, new_hand
from torchgrasp.foundation.errors import BadArgument, HandFileError
from torchgrasp.hand.load import load_hand
from torchgrasp.testing import check_hand, random_joints

pytestmark = pytest.mark.usefixtures("few_draws")

mujoco = pytest.importorskip("mujoco")


def write_draft(draft: Draft, folder) -> str:
    """Write a drafted hand, and return what was told."""
    folder.mkdir(exist_ok=True)
    (folder / "hand.toml").write_text(draft.toml)
    (folder / "hand.urdf").write_text(draft.urdf)
    return "\n".join([*draft.repairs, *draft.warnings])


@pytest.fixture(scope="module", params=list(HANDS))
def drafted(request, tmp_path_factory):
    """Each hand: its compiled model, the folder of its draft, and what was told."""
    folder = tmp_path_factory.mktemp(request.param)
    file = folder / "hand.xml"
    file.write_text(HANDS[request.param]())
    told = write_draft(new_hand(file), folder)
    return mujoco.MjModel.from_xml_path(str(file)), folder, told


def place(engine, data, hand, joints):
    """Set a posture of our hand in MuJoCo, and compute its kinematics and constraints."""
    data.qpos[:] = engine.qpos0
    for name, value in hand.expand(joints).items():
        data.qpos[engine.joint(name).qposadr[0]] = float(value)
    mujoco.mj_forward(engine, data)


def test_links_and_tips_are_where_mujoco_has_them(drafted):
    engine, folder, _ = drafted
    hand = check_hand(folder)
    data = mujoco.MjData(engine)
    joints = random_joints(hand, 25)
    poses = hand.link_poses(joints).numpy()
    palm = engine.body("palm").id
    worst = 0.0
    for row in range(len(joints)):
        place(engine, data, hand, joints[row])
        turn = data.xmat[palm].reshape(3, 3)
        for k, name in enumerate(hand.tree.link_names):
            if name not in [engine.body(i).name for i in range(engine.nbody)]:
                continue
            body = engine.body(name).id
            # our frame is at the last joint of the body
            count = int(engine.body_jntnum[body]) if body != palm else 0
            last = int(engine.body_jntadr[body]) + count - 1
            local = engine.jnt_pos[last] if count else np.zeros(3)
            own = data.xmat[body].reshape(3, 3)
            wanted = turn.T @ (data.xpos[body] + own @ local - data.xpos[palm])
            worst = max(worst, float(np.abs(poses[row, k, :3, 3] - wanted).max()))
            worst = max(worst, float(np.abs(poses[row, k, :3, :3] - turn.T @ own).max()))
        # every equality holds
        assert np.abs(data.efc_pos[: data.ne]).max(initial=0.0) < 1e-6
    assert worst < 1e-6
    assert len(hand.tips) == 3


def test_limits_and_efforts_are_those_of_the_file(drafted):
    engine, folder, told = drafted
    hand = load_hand(folder)
    arms = np.zeros((engine.nu, engine.nv))
    data = mujoco.MjData(engine)
    mujoco.mj_forward(engine, data)
    for k in range(engine.nu):
        first = int(data.moment_rowadr[k])
        for at in range(first, first + int(data.moment_rownnz[k])):
            arms[k, int(data.moment_colind[at])] = data.actuator_moment.ravel()[at]
    for name, low, high in zip(hand.joint_names, hand.lower, hand.upper, strict=True):
        joint = engine.joint(name)
        # a follower narrows its leader, which is told
        if f"joint {name} is limited to" in told:
            assert joint.range[0] <= float(low) and float(high) <= joint.range[1]
        else:
            np.testing.assert_allclose([float(low), float(high)], joint.range, atol=1e-12)
    for name, drive in hand.actuators.items():
        column = arms[:, engine.joint(name).dofadr[0]]
        force = 0.6 if "seven" in engine.names.decode() else 1.5
        most = sum(
            abs(arm) * (engine.actuator_forcerange[k, 1] or force)
            for k, arm in enumerate(column)
            if arm
        )
        if most:
            assert drive.effort == pytest.approx(most)


def test_the_jug_is_planned_and_lifted(tmp_path):
    pytest.importorskip("sapien")
    file = tmp_path / "hand.xml"
    file.write_text(HANDS["seven"]())
    write_draft(new_hand(file), tmp_path)
    hand = load_hand(tmp_path)
    jug = load_object("jug")
    grasps = plan_grasps(jug.view, hand, starts=10)
    assert int(grasps.status[0]) == int(Status.OK)
    # the unseen back of the jug may be where a first grasp begins
    assert any(close_hand(grasps[k : k + 1], hand, jug, QUICK).held for k in range(4))


def test_a_motor_of_several_joints_takes_the_posture_in_which_mujoco_comes_to_rest(tmp_path):
    """The quasi-static rule: without gravity and touch, the pulled finger settles as we say."""
    file = tmp_path / "hand.xml"
    file.write_text(tendon_hand())
    write_draft(new_hand(file), tmp_path)
    hand = load_hand(tmp_path)
    text = tendon_hand().replace("<default>", '<option gravity="0 0 0"/><default>', 1)
    engine = mujoco.MjModel.from_xml_string(text)
    engine.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data = mujoco.MjData(engine)
    mujoco.mj_resetData(engine, data)
    data.ctrl[engine.actuator("left").id] = 0.05
    data.ctrl[engine.actuator("right").id] = 0.04
    for _ in range(3000):
        mujoco.mj_step(engine, data)
    found = {name: float(data.joint(name).qpos[0]) for name in hand.tree.joint_names}
    joints = torch.tensor([found[name] for name in hand.joint_names], dtype=torch.float64)
    for name, value in hand.expand(joints).items():
        if name.startswith(("left", "right")):
            assert float(value) == pytest.approx(found[name], abs=1e-3), name
    assert found["left_bend"] > 0.1 and found["right_curl"] > 0.1


def one(rest: str) -> str:
    """A hand of three fingers whose tendons and motors are `rest`."""
    text = HANDS["seven"]()
    begin = text.index("<actuator>")
    return text[:begin] + rest + "</mujoco>"


SEVEN = ["thumb_swivel"] + [
    f"{n}_{j}" for n in ("left", "right", "thumb") for j in ("bend", "curl")
]


@pytest.mark.parametrize(
    ("rest", "match"),
    [
        ("", "an actuator for every motor.*got .*no actuator"),
        (
            '<tendon><spatial name="rope"><site site="s"/><site site="t"/></spatial></tendon>'
            f'<actuator>{motors(SEVEN)}<motor tendon="rope"/></actuator>',
            "<fixed> tendons.*got .*spatial tendon rope",
        ),
        (
            '<equality><joint name="e" joint1="left_curl" joint2="left_bend" '
            'polycoef="0 1 0 0.1 0"/></equality>'
            f"<actuator>{motors(SEVEN)}</actuator>",
            'the nearest is polycoef="[^"]* 0 0 0".*equality e of left_curl to left_bend.*degree 3',
        ),
        (
            '<equality><connect body1="left_curl" body2="right_curl" anchor="0 0 0"/></equality>'
            f"<actuator>{motors(SEVEN)}</actuator>",
            "closes a loop",
        ),
        (
            '<equality><joint joint1="left_curl" polycoef="0.1 0 0 0 0"/>'
            '<joint joint1="left_curl" polycoef="0.2 0 0 0 0"/></equality>'
            f"<actuator>{motors(SEVEN)}</actuator>",
            "agree with each other",
        ),
        (f'<include file="../x.xml"/><actuator>{motors(SEVEN)}</actuator>', "outside|missing"),
        (f"<actuator>{motors(['none'])}</actuator>", "that MuJoCo compiles"),
    ],
)
def test_what_no_hand_can_be_is_refused_in_one_sentence(tmp_path, rest, match):
    file = tmp_path / "hand.xml"
    text = one(rest).replace('<body name="left_bend"', '<site name="s"/><body name="left_bend"')
    text = text.replace('<joint name="left_bend"', '<site name="t"/><joint name="left_bend"')
    file.write_text(text)
    with pytest.raises(HandFileError, match=match) as error:
        new_hand(file)
    assert "\n" not in str(error.value) and str(file) in str(error.value)


def test_two_hands_in_one_file_need_a_root(tmp_path):
    text = HANDS["seven"]()
    begin = text.index('<body name="palm"')
    end = text.index("</worldbody>")
    other = text[begin:end].replace('name="', 'name="other_').replace("0 0 0.3", "1 0 0.3")
    names = motors(SEVEN + [f"other_{n}" for n in SEVEN])
    text = text[:end] + other + text[end : text.index("<actuator>")]
    file = tmp_path / "hand.xml"
    file.write_text(f"{text}<actuator>{names}</actuator></mujoco>")
    with pytest.raises(HandFileError, match=r"--root BODY.*palm and other_palm"):
        new_hand(file)
    with pytest.raises(BadArgument, match=r"root.*'fist'"):
        new_hand(file, Wish(root="fist"))
    told = write_draft(new_hand(file, Wish(root="other_palm")), tmp_path)
    assert load_hand(tmp_path).joint_names[0].startswith("other_")
    assert "left out: palm" in told


def test_files_of_an_mjcf_are_read_below_its_folder_alone(tmp_path):
    """An included default class, a mesh in its folder, degrees; the same hand as one file."""
    import trimesh

    text = HANDS["seven"]()
    begin = text.index("<default>")
    end = text.index("<worldbody>")
    (tmp_path / "parts").mkdir()
    (tmp_path / "meshes").mkdir()
    trimesh.creation.icosphere(3, 11.0).export(tmp_path / "meshes" / "pad.stl")
    head = text[begin:end]
    (tmp_path / "parts" / "head.xml").write_text(f"<mujocoinclude>{head}</mujocoinclude>")
    mesh = '<asset><mesh file="pad.stl" scale="0.001 0.001 0.001"/><texture file="no.png"/></asset>'
    ball = '<geom class="pad" pos'
    split = text[:begin] + '<include file="parts/head.xml"/>' + mesh + text[end:]
    split = split.replace("<compiler", '<compiler meshdir="meshes"')
    split = split.replace(ball, '<geom type="mesh" mesh="pad" pos')
    file = tmp_path / "hand.xml"
    file.write_text(split)
    told = write_draft(new_hand(file), tmp_path)
    assert "3 collision meshes" in told
    hand = load_hand(tmp_path)
    assert float((hand.tip_radius - 0.011).abs().max()) < 3e-4
    (tmp_path / "away").mkdir()
    for old, new, match in (
        ('file="pad.stl"', 'file="../../pad.stl"', "outside of this folder"),
        ('file="pad.stl"', 'file="/etc/pad.stl"', "an absolute path"),
        ('file="pad.stl"', 'file="other.stl"', "missing"),
        ("parts/head.xml", "hand.xml", "twice"),
        ("<asset>", "<!DOCTYPE x><asset>", "DOCTYPE"),
        ("<worldbody>", '<worldbody><replicate count="9999"/>', "<replicate>"),
        ("<worldbody>", "<worldbody><body><attach/></body>", "<attach>"),
    ):
        assert old in split
        file.write_text(split.replace(old, new, 1))
        with pytest.raises(HandFileError, match=match):
            new_hand(file)


def test_sums_of_joints_come_from_tendons_of_two_motors(tmp_path):
    """A finger that follows the mean of two others: MuJoCo's equality of tendons."""
    rest = (
        '<tendon><fixed name="one"><joint joint="left_curl" coef="1"/></fixed>'
        '<fixed name="two"><joint joint="left_bend" coef="0.5"/>'
        '<joint joint="right_bend" coef="0.25"/></fixed></tendon>'
        '<equality><tendon tendon1="one" tendon2="two" polycoef="0.2 1 0 0 0"/></equality>'
        f"<actuator>{motors([n for n in SEVEN if n != 'left_curl'])}</actuator>"
    )
    file = tmp_path / "hand.xml"
    file.write_text(one(rest))
    told = write_draft(new_hand(file), tmp_path)
    hand = check_hand(tmp_path)
    joints = random_joints(hand, 5)
    found = hand.expand(joints)
    wanted = 0.5 * found["left_bend"] + 0.25 * found["right_bend"] + 0.2
    torch.testing.assert_close(found["left_curl"], wanted)
    assert "left_curl follows a sum" in told
    assert (
        'sources = { "left_bend" = 0.5, "right_bend" = 0.25 }'
        in (tmp_path / "hand.toml").read_text()
    )


def servo(name, more):
    return f'<position name="{name}" joint="{name}" kp="5" forcerange="-2 2" {more}/>'


@pytest.mark.parametrize(
    ("motor", "ends"),
    [
        (servo("left_bend", 'ctrlrange="-0.2 0.9"'), (-0.2, 0.9)),
        # the servo turns a gear: its control is in turns of the motor
        (servo("left_bend", 'gear="2" ctrlrange="-0.4 1.0"'), (-0.2, 0.5)),
        (
            '<general name="left_bend" joint="left_bend" biastype="affine" gainprm="0.02" '
            'biasprm="0.3 -3 0" ctrlrange="0 100" forcerange="-2 2"/>',
            (0.1, 0.3 / 3 + 2 / 3),
        ),
        (servo("left_bend", 'ctrlrange="-3 3"'), None),
        (
            '<intvelocity name="left_bend" joint="left_bend" kp="5" ctrlrange="-0.1 0.1" '
            'actrange="-0.1 1.2" forcerange="-2 2"/>',
            (-0.1, 1.2),
        ),
    ],
)
def test_joints_are_narrowed_to_what_their_servo_reaches(tmp_path, motor, ends):
    others = motors([name for name in SEVEN if name != "left_bend"])
    file = tmp_path / "hand.xml"
    file.write_text(one(f"<actuator>{others}{motor}</actuator>"))
    told = write_draft(new_hand(file), tmp_path)
    hand = load_hand(tmp_path)
    at = hand.joint_names.index("left_bend")
    found = float(hand.lower[at]), float(hand.upper[at])
    assert found == pytest.approx(ends or (-np.pi / 4, np.pi / 2))
    assert ("joint left_bend is narrowed by the control of left_bend" in told) == (ends is not None)
