"""Files of other publishers, rebuilt by small writers: frames, wrists, couplings and signs.

Fingertips after the import are held against those of the file's own posture, by SciPy's rotations
and the tree of all joints.
"""

import json
import warnings

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.pinch import pinch
from torchgrasp import load_grasps, load_hand
from torchgrasp.app import cli
from torchgrasp.export import format_grasps, grasps_from_joints, read_foreign
from torchgrasp.foundation.errors import GraspFileWarning, ModelFileError

SAME = 1e-4  # [m]
CAMERA = np.array([0.711, 0.041, 0.020]), Rotation.from_rotvec([0.3, -0.8, 1.9])


def middle(hand, share=0.4):
    """Joints (1, h) at a share of their ranges."""
    return (hand.lower + share * (hand.upper - hand.lower))[None]


def tips(hand, every, place):
    """Fingertips (f, 3) of the posture `every` of all joints, whose root stands at `place`."""
    poses = hand.tree.poses(torch.as_tensor(every)[None])[0].numpy()
    position, turn = place
    points = []
    for link, contact in zip(hand.tips.links, hand.tips.contact.numpy(), strict=True):
        pose = poses[hand.tree.link_names.index(link)]
        points.append(pose[:3, :3] @ contact + pose[:3, 3])
    return turn.apply(points) + position


def row(place, posture, quaternion="wxyz"):
    """A line of a file: pose, then joints."""
    position, turn = place
    return np.concatenate([position, numbers(turn, quaternion), posture])


def numbers(turn, quaternion):
    """The four numbers of a rotation in either order."""
    return turn.as_quat(scalar_first=quaternion == "wxyz")


def within(place, outer):
    """A place in the frame `outer`, given that in the frame of `outer`'s parent."""
    turn = outer[1].inv()
    return turn.apply(place[0] - outer[0]), turn * place[1]


def imported(hand, read):
    """Fingertips (f, 3) of the first grasp, and of its opened hand, in the object's frame."""
    pose = read.obj_from_hand[0].numpy()
    place = pose[:3, 3], Rotation.from_matrix(pose[:3, :3])
    both = (read.joints, read.joints if read.pregrasp is None else read.pregrasp)
    return [tips(hand, hand.expand_joints(joints)[0], place) for joints in both]


@pytest.mark.parametrize("quaternion", ["wxyz", "xyzw"])
@pytest.mark.parametrize("many", [False, True])
@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_poses_in_the_world_are_moved_to_the_frame_of_the_object(tmp_path, quaternion, many, scale):
    hand = load_hand("leap", "four")
    every = hand.expand_joints(middle(hand))[0].numpy()
    world = np.array([0.6, 0.1, 0.2]), Rotation.from_rotvec([1.0, 0.2, -0.4])
    line = row((scale * world[0], world[1]), every, quaternion)
    body = np.concatenate([scale * CAMERA[0], numbers(CAMERA[1], quaternion)])
    tables = {"grasp_qpos": line[None], "obj_pose": body[None] if many else body}
    tables |= {"obj_scale": 0.1, "obj_path": "a/b", "squeeze_qpos": line}
    np.savez(tmp_path / "a.npz", **tables)
    read = read_foreign(tmp_path / "a.npz", hand, hand.tree.joint_names, quaternion, 1 / scale)
    wanted = tips(hand, every, within(world, CAMERA))
    assert np.abs(imported(hand, read)[0] - wanted).max() < SAME
    pose, joints = line[:7].tolist(), line[7:].tolist()
    content = {"pose": [pose], "dofs": [joints], "obj_pose": body.tolist()}
    (tmp_path / "a.json").write_text(json.dumps(content))
    read = read_foreign(tmp_path / "a.json", hand, hand.tree.joint_names, quaternion, 1 / scale)
    assert np.abs(imported(hand, read)[0] - wanted).max() < SAME


def test_the_fingers_take_up_the_motion_of_a_wrist(tmp_path):
    hand = load_hand("allegro")
    every = [hand.expand_joints(middle(hand, share))[0].numpy() for share in (0.45, 0.4)]
    world = np.array([0.6, 0.1, 0.2]), Rotation.from_rotvec([1.0, 0.2, -0.4])
    shift = np.array([0.003, -0.002, 0.004])
    before = world[0] + shift, Rotation.from_rotvec([0.02, 0.03, -0.02]) * world[1]
    tables = {"grasp_qpos": row(world, every[0]), "pregrasp_qpos": row(before, every[1])}
    body = np.concatenate([CAMERA[0], numbers(CAMERA[1], "wxyz")])
    np.savez(tmp_path / "a.npz", **tables, obj_pose=body)
    read = read_foreign(tmp_path / "a.npz", hand)
    # the bench's hand is our palm turned, as its published model says
    turn = Rotation.from_quat([1.0, 0.0, 1.0, 0.0])
    found = imported(hand, read)
    for place, joints, points in zip((world, before), every, found, strict=True):
        wanted = tips(hand, joints, within((place[0], place[1] * turn), CAMERA))
        assert np.abs(points - wanted).max() < SAME
    hand.check_joints(read.pregrasp)


def test_a_wrist_whose_motion_no_fingers_can_take_up_is_told(tmp_path):
    hand = load_hand("barrett")
    every = hand.expand_joints(middle(hand))[0].numpy()
    world = np.array([0.0, 0.0, 0.2]), Rotation.identity()
    before = np.array([0.0, 0.0, 0.206]), Rotation.identity()
    np.savez(tmp_path / "a.npz", grasp_qpos=row(world, every), pregrasp_qpos=row(before, every))
    with pytest.warns(GraspFileWarning, match="pregrasp of 1 of 1 grasps") as told:
        read = read_foreign(tmp_path / "a.npz", hand, hand.tree.joint_names)
    hand.check_joints(read.pregrasp)
    off = np.linalg.norm(imported(hand, read)[1] - tips(hand, every, before), axis=1)
    assert off.max() > SAME and f"up to {1000 * off.max():.1f} mm" in str(told[0].message)


@pytest.mark.parametrize("kind", ["npz", "json", "own"])
def test_a_joint_that_does_not_follow_as_in_the_hand_is_named(tmp_path, kind):
    hand = load_hand("shadow")
    names = hand.tree.joint_names
    own = hand.expand_joints(middle(hand))[0].numpy()
    apart = own.copy()
    apart[names.index("MFJ1")] = 0.1

    def read(every):
        line = row((np.zeros(3), Rotation.identity()), every)
        if kind == "npz":
            np.savez(tmp_path / "a.npz", grasp_qpos=line)
            return read_foreign(tmp_path / "a.npz", hand, names)
        pose, posture = line[:7].tolist(), line[7:].tolist()
        content = {"pose": [pose], "dofs": [posture]}
        if kind == "own":
            joints = dict(zip(names, posture, strict=True))
            place = {"position": pose[:3], "quaternion_wxyz": pose[3:]}
            grasp = {"joints": {"grasp": joints, "pregrasp": joints}, "pose": place}
            content = {"grasps": [grasp]}
        (tmp_path / "a.json").write_text(json.dumps(content))
        return read_foreign(tmp_path / "a.json", hand, names)

    near = own + 2e-4 * (np.array(names) == "MFJ1")  # as coupled as a tendon is
    wanted = tips(hand, near, (np.zeros(3), Rotation.identity()))
    assert np.abs(imported(hand, read(near))[0] - wanted).max() < SAME
    with pytest.raises(ModelFileError, match=r"MFJ1 at 0\.1, 0\.628 by its coupling to MFJ2"):
        read(apart)


def test_the_barrett_hand_of_multigrippergrasp_has_eight_numbers(tmp_path):
    hand = load_hand("barrett")
    order = ("spread", "spread_mimic", "f3_flex", "f1_flex", "f2_flex")
    order += ("f3_distal", "f1_distal", "f2_distal")
    values = hand.expand(middle(hand))
    dofs = [float(values[name][0]) for name in order]
    place = np.array([0.1, 0.0, 0.2]), Rotation.from_rotvec([0.1, 0.2, 0.3])
    file = tmp_path / "a.json"

    def write(posture):
        file.write_text(json.dumps({"pose": [row(place, []).tolist()], "dofs": [posture]}))

    wanted = tips(hand, hand.expand_joints(middle(hand))[0], place)
    write(dofs)
    assert np.abs(imported(hand, read_foreign(file, hand, order))[0] - wanted).max() < SAME
    # a distal joint in the turns of its motor, as an axis of length 1/3 writes it
    write(dofs[:5] + [3 * x for x in dofs[5:]])
    third = (*order[:5], *(f"{name}:{1 / 3}" for name in order[5:]))
    assert np.abs(imported(hand, read_foreign(file, hand, third))[0] - wanted).max() < SAME
    with pytest.raises(ModelFileError, match=r"f._distal at .* by its coupling to f._flex"):
        read_foreign(file, hand, order)


def test_a_thumb_of_the_other_sign_is_refused_or_told_and_turns_with_a_factor(tmp_path):
    hand = load_hand("shadow", "five")
    names = hand.tree.joint_names
    own = hand.expand_joints(middle(hand))[0].numpy()
    place = np.zeros(3), Rotation.identity()
    thumb = names.index("THJ1")
    flipped = [f"{name}:-1" if name == "THJ1" else name for name in names]
    kept = [f"{name}:1" if name == "THJ1" else name for name in names]
    for bend, told, sign in (
        (0.7, ModelFileError, "THJ1:-1"),
        (0.2, GraspFileWarning, "JOINT:-1"),
    ):
        own[thumb] = bend
        theirs = np.where(np.arange(len(names)) == thumb, -own, own)
        np.savez(tmp_path / "a.npz", grasp_qpos=row(place, theirs))
        with (pytest.raises if told is ModelFileError else pytest.warns)(
            told, match=f"{sign}.* to -{bend}|to -{bend}.*{sign}"
        ):
            read_foreign(tmp_path / "a.npz", hand, names)
        read = read_foreign(tmp_path / "a.npz", hand, flipped)
        assert np.abs(imported(hand, read)[0] - tips(hand, own, place)).max() < SAME
    read = read_foreign(tmp_path / "a.npz", hand, kept)
    assert np.abs(imported(hand, read)[0] - tips(hand, theirs, place)).max() < SAME


def test_degrees_and_another_zero_are_converted(tmp_path):
    hand = load_hand("leap", "four")
    own = hand.expand_joints(middle(hand))[0].numpy()
    names = hand.tree.joint_names
    degrees = np.degrees(own - 0.25)
    order = [f"{name}:{np.radians(1)}:0.25" for name in names]
    place = np.zeros(3), Rotation.identity()
    np.savez(tmp_path / "a.npz", grasp_qpos=row(place, degrees))
    read = read_foreign(tmp_path / "a.npz", hand, order)
    assert np.abs(imported(hand, read)[0] - tips(hand, own, place)).max() < SAME
    for wrong in ("1:x", "1:0", "1:nan", "1:1:2:3", "1:"):
        with pytest.raises(ValueError, match="order"):
            read_foreign(tmp_path / "a.npz", hand, [wrong, *order[1:]])


@pytest.mark.parametrize("name", ["allegro", "leap"])
def test_the_names_of_joints_in_a_file_are_its_order(tmp_path, name):
    """DexGraspBench reorders postures by `joint_names`: they hold before any usual order."""
    hand = load_hand(name)
    every = hand.expand_joints(middle(hand))[0].numpy()
    place = np.array([0.1, 0.0, 0.2]), Rotation.identity()
    names = np.array(hand.tree.joint_names)
    turned = np.random.default_rng(0).permutation(len(names))
    file = tmp_path / "a.npz"
    np.savez(file, grasp_qpos=row(place, every[turned]), joint_names=names[turned])
    torch.testing.assert_close(read_foreign(file, hand).joints, middle(hand))
    # a given order holds before that of the file
    np.savez(file, grasp_qpos=row(place, every), joint_names=names[turned])
    torch.testing.assert_close(read_foreign(file, hand, names.tolist()).joints, middle(hand))
    np.savez(file, grasp_qpos=row(place, every), joint_names=[f"rh_{x}" for x in names])
    with pytest.raises(ModelFileError, match=r"in this order: .* --joints, got .*joint_names rh_"):
        read_foreign(file, hand)


def test_values_that_are_not_kept_are_told(tmp_path):
    hand = load_hand("allegro")
    every = hand.expand_joints(middle(hand))[0].numpy()
    line = row((np.zeros(3), Rotation.identity()), every)
    line[7 + 9] += 0.5  # of the finger that does not grasp
    np.savez(tmp_path / "a.npz", grasp_qpos=line, wrench=np.zeros(3))
    with pytest.warns(GraspFileWarning) as told:
        read_foreign(tmp_path / "a.npz", hand)
    words = [str(x.message) for x in told]
    assert any("joint_9 move" in x for x in words) and any("not read: wrench" in x for x in words)


def test_a_hand_that_our_file_raises_is_raised_again(tmp_path):
    hand, grasp = pinch("barrett")
    content = json.loads(format_grasps(hand, grasp))
    content["grasps"][0]["rise"] = [0.0, 0.0, 0.012]
    file = tmp_path / "a.json"
    content["provenance"]["table"] = "normal 0 0 1, offset -0.05"
    file.write_text(json.dumps(content))
    read = read_foreign(file, hand)
    assert grasps_from_joints(hand, *read).table.offset == -0.05
    content["provenance"]["table"] += "; edge normal 1 0 0, offset 0.3"
    file.write_text(json.dumps(content))
    edge = read_foreign(file, hand).table.edge
    assert edge.normal.tolist() == [1.0, 0.0, 0.0] and edge.offset == 0.3
    content["provenance"]["table"] = "none"
    file.write_text(json.dumps(content))
    with pytest.warns(GraspFileWarning, match="no table"):
        assert read_foreign(file, hand).table is None


def test_the_command_names_the_joint_and_writes_nothing(tmp_path, capsys):
    hand = load_hand("shadow")
    names = hand.tree.joint_names
    every = hand.expand_joints(middle(hand))[0].numpy()
    every[names.index("FFJ1")] = 0.0
    line = row((np.array([0.0, 0.0, 0.2]), Rotation.identity()), every)
    np.savez(tmp_path / "a.npz", grasp_qpos=line)
    out = tmp_path / "a.safetensors"
    words = ["import", str(tmp_path / "a.npz"), "--hand", "shadow", "--out", str(out), "--joints"]
    assert cli.main([*words, *names]) == 2 and not out.exists()
    assert "FFJ1 at 0, 0.628 by its coupling to FFJ2" in capsys.readouterr().err
    skipped = ["-" if name == "FFJ1" else name for name in names]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert cli.main([*words, *("theirs" if x == "-" else x for x in skipped)]) in (0, 1)


@pytest.mark.parametrize("kind", ["json", "npz", "own"])
def test_poses_of_another_link_are_moved_to_our_root_by_its_name(tmp_path, kind):
    hand = load_hand("shadow", "five")
    names = hand.tree.joint_names
    every = hand.expand_joints(middle(hand))[0].numpy()
    place = np.array([0.1, 0.0, 0.2]), Rotation.from_rotvec([0.4, -0.2, 0.3])
    wanted = tips(hand, every, place)
    poses = hand.tree.poses(torch.as_tensor(every)[None])[0].numpy()
    # one fixed to the root or not, and a link of a finger
    for link in (hand.tree.link_names[1], hand.tips.links[0]):
        pose = poses[hand.tree.link_names.index(link)]
        of_link = (
            place[1].apply(pose[:3, 3]) + place[0],
            place[1] * Rotation.from_matrix(pose[:3, :3]),
        )
        line = row(of_link, every)
        file = tmp_path / f"a.{'npz' if kind == 'npz' else 'json'}"
        given = {}
        if kind == "npz":
            np.savez(file, grasp_qpos=line)
            given["root"] = link
        elif kind == "json":
            content = {"pose": [line[:7].tolist()], "dofs": [every.tolist()], "root_link": link}
            file.write_text(json.dumps(content))
        else:
            joints = dict(zip(names, every.tolist(), strict=True))
            at = {"position": line[:3].tolist(), "quaternion_wxyz": line[3:7].tolist()}
            grasp = {"joints": {"grasp": joints, "pregrasp": joints}, "pose": at}
            file.write_text(json.dumps({"hand": {"root": link}, "grasps": [grasp]}))
        read = read_foreign(file, hand, names, **given)
        assert np.abs(imported(hand, read)[0] - wanted).max() < SAME
        # the frame that a pose gives, in the place of its name
        inside = torch.linalg.inv(torch.as_tensor(pose))
        again = read_foreign(file, hand, names, root=inside)
        assert np.abs(imported(hand, again)[0] - wanted).max() < SAME


@pytest.mark.parametrize("kind", ["json", "own", "given"])
def test_a_root_link_that_is_none_of_ours_is_refused_by_name(tmp_path, kind):
    hand = load_hand("barrett")
    every = hand.expand_joints(middle(hand))[0].numpy()
    line = row((np.zeros(3), Rotation.identity()), every)
    content = {"pose": [line[:7].tolist()], "dofs": [every.tolist()]}
    if kind == "json":
        content["base_link"] = "forearm"
    if kind == "own":
        joints = dict(zip(hand.tree.joint_names, every.tolist(), strict=True))
        at = {"position": [0.0] * 3, "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}
        grasp = {"joints": {"grasp": joints, "pregrasp": joints}, "pose": at}
        content = {"hand": {"root": "forearm"}, "grasps": [grasp]}
    (tmp_path / "a.json").write_text(json.dumps(content))
    root = "forearm" if kind == "given" else ""
    with pytest.raises(ModelFileError, match=r"--root.*poses of the link forearm"):
        read_foreign(tmp_path / "a.json", hand, hand.tree.joint_names, root=root)


def test_the_command_takes_the_pose_of_the_root_in_the_frame_of_the_file(tmp_path, capsys):
    hand = load_hand("barrett")
    every = hand.expand_joints(middle(hand))[0].numpy()
    place = np.array([0.0, 0.0, 0.2]), Rotation.from_rotvec([0.1, 0.2, 0.3])
    turn = Rotation.from_rotvec([0.0, 0.0, 1.0])
    shift = np.array([0.01, 0.02, 0.03])
    line = row((place[0] - (place[1] * turn.inv()).apply(shift), place[1] * turn.inv()), every)
    np.savez(tmp_path / "a.npz", grasp_qpos=line)
    out = tmp_path / "a.safetensors"
    words = ["import", str(tmp_path / "a.npz"), "--hand", "barrett", "--out", str(out)]
    words += ["--joints", *hand.tree.joint_names, "--root"]
    pose = [*shift, *turn.as_quat(scalar_first=True)]
    assert cli.main([*words, *map(str, pose)]) in (0, 1)
    found = load_grasps(out)
    wanted = tips(hand, every, place)
    assert np.abs(found.contacts.points[0].numpy() - wanted).max() < SAME
    assert cli.main([*words, "1", "2"]) == 2
    assert "--root" in capsys.readouterr().err


ORDERS = {
    "ada-grasp-ctrl, LEAP": ("leap", "four", "1 0 2 3 5 4 6 7 9 8 10 11 12 13 14 15"),
    "BODex, LEAP, YAML": ("leap", "four", "12 13 14 15 1 0 2 3 5 4 6 7 9 8 10 11"),
    "BODex, LEAP, URDF": ("leap", "four", "12 13 14 15 0 1 2 3 8 9 10 11 4 5 6 7"),
    "MultiGripperGrasp, Allegro": (
        "allegro",
        "four",
        "joint_0 joint_12 joint_4 joint_8 joint_1 joint_13 joint_5 joint_9 joint_2 joint_14 "
        "joint_6 joint_10 joint_3 joint_15 joint_7 joint_11",
    ),
    "dex-urdf, left Allegro by place": (
        "allegro",
        "four",
        "joint_8 joint_9 joint_10 joint_11 joint_4 joint_5 joint_6 joint_7 joint_0 joint_1 "
        "joint_2 joint_3 joint_12 joint_13 joint_14 joint_15",
    ),
    "dex-urdf, Barrett": (
        "barrett",
        "default",
        "spread:-1 f1_flex:-1 f1_distal:-1 spread_mimic f2_flex:-1 f2_distal:-1 f3_flex:-1 "
        "f3_distal:-1",
    ),
}


@pytest.mark.parametrize("name", ORDERS)
@pytest.mark.parametrize("kind", ["npz", "json"])
def test_the_orders_and_signs_of_publishers_are_read(tmp_path, name, kind):
    hand_name, fingers, words = ORDERS[name]
    hand = load_hand(hand_name, fingers)
    share = torch.linspace(0.2, 0.6, hand.dof, dtype=torch.float64)
    joints = (hand.lower + share * (hand.upper - hand.lower))[None]
    own = {joint: float(x[0]) for joint, x in hand.expand(joints).items()}
    pairs = [word.partition(":") for word in words.split()]
    values = [own[joint] / float(factor or 1) for joint, _, factor in pairs]
    place = np.array([0.1, 0.0, 0.2]), Rotation.from_rotvec([0.4, -0.2, 0.3])
    file = tmp_path / f"a.{kind}"
    line = row(place, values)
    if kind == "npz":
        np.savez(file, grasp_qpos=line)
        turned = Rotation.from_quat([1.0, 0.0, 1.0, 0.0])  # the bench's Allegro hand
        place = place if hand_name != "allegro" else (place[0], place[1] * turned)
    else:
        file.write_text(json.dumps({"pose": [line[:7].tolist()], "dofs": [values]}))
    read = read_foreign(file, hand, words.split())
    wanted = tips(hand, hand.expand_joints(joints)[0], place)
    assert np.abs(imported(hand, read)[0] - wanted).max() < SAME


def test_quaternions_of_the_other_order_are_told(tmp_path):
    hand = load_hand("barrett")
    every = hand.expand_joints(middle(hand))[0].numpy()
    turns = Rotation.random(12, random_state=0)
    origin = np.array([0.02, 0.0, 0.11]) + np.random.default_rng(0).normal(0.0, 0.01, (12, 3))
    places = -turns.apply(origin)  # the object on one side of every hand

    def read(rows, quaternion, **world):
        np.savez(tmp_path / "a.npz", grasp_qpos=np.array(rows), **world)
        read_foreign(tmp_path / "a.npz", hand, hand.tree.joint_names, quaternion)

    for order, other in (("wxyz", "xyzw"), ("xyzw", "wxyz")):
        rows = [row(place, every, order) for place in zip(places, turns, strict=True)]
        read(rows, order)
        with pytest.warns(GraspFileWarning, match=f"--quaternion {order}"):
            read(rows, other)
        read(rows[:4], other)  # of four, one side may be chance
        still = row((np.zeros(3), Rotation.identity()), [], order)
        read(rows, order, obj_pose=still)
        with pytest.warns(GraspFileWarning, match=f"half turns, and no turns as {order}"):
            read(rows[:4], other, obj_pose=still)
        # hands in the world, whose origin is anywhere
        far = row((np.array([0.0, 0.0, 5.0]), Rotation.from_rotvec([0.0, 0.3, 0.0])), [], other)
        read(rows, other, obj_pose=far)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("format", "their grasps", "torchgrasp grasps"),
        ("version", 4, "a number in"),
        ("units", {"angle": "deg"}, "expected rad"),
        ("units", {"length": "mm"}, "expected m,"),
    ],
)
def test_our_json_of_another_format_or_unit_is_refused(tmp_path, key, value, said):
    hand, grasp = pinch("barrett")
    content = json.loads(format_grasps(hand, grasp))
    content[key] = content[key] | value if isinstance(value, dict) else value
    file = tmp_path / "grasps.json"
    file.write_text(json.dumps(content))
    with pytest.raises(ModelFileError, match=said):
        read_foreign(file, hand)


def test_what_a_simulation_adds_to_its_grasps_and_another_gripper_are_told(tmp_path):
    """MultiGripperGrasp's `dofs` begin a trial; `result` and `final_dofs` are what came of it."""
    hand, grasp = pinch("barrett")
    turn = Rotation.from_matrix(grasp.obj_from_hand[0, :3, :3].numpy()).as_quat(scalar_first=True)
    every = hand.expand_joints(grasp.joints).tolist()
    content = {
        "gripper": "Barrett",
        "object_ID": "cup",
        "pose": [[*grasp.obj_from_hand[0, :3, 3].tolist(), *turn.tolist()]],
        "dofs": every,
        "test_duration": 3,
    }
    file = tmp_path / "grasps.json"
    file.write_text(json.dumps(content))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_foreign(file, hand, hand.tree.joint_names)
    file.write_text(json.dumps(content | {"result": [0], "final_dofs": every}))
    with pytest.warns(GraspFileWarning, match="not read: final_dofs, result"):
        read_foreign(file, hand, hand.tree.joint_names)
    file.write_text(json.dumps(content | {"gripper": "HumanHand"}))
    with pytest.warns(GraspFileWarning, match="gripper HumanHand, read for the barrett hand"):
        read_foreign(file, hand, hand.tree.joint_names)
