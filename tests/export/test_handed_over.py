"""Grasps in others' formats, read back by independent readers and by kinematics written from the
published models.
"""

import dataclasses
import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.make import near
from tests.pinch import cylinder, pinch
from torchgrasp import certify, load_hand
from torchgrasp.app import cli
from torchgrasp.cloud import look_at, partial_view, save_cloud
from torchgrasp.control.finger_forces import squeeze
from torchgrasp.export import (
    format_graspgen,
    format_grasps,
    format_isaac,
    format_keyframes,
    format_moveit,
    format_trajectories,
    grasps_from_joints,
    read_foreign,
    save_dexgraspbench,
    save_play,
)
from torchgrasp.foundation.errors import BadArgument, GraspFileWarning, ModelFileError, Status
from torchgrasp.geometry.plane import Plane

yaml = pytest.importorskip("yaml")


def pose(position, quaternion):
    """A 4 x 4 pose of a position and a quaternion (w, x, y, z) of any length."""
    w, x, y, z = quaternion
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    matrix[:3, 3] = position
    return matrix


def turned(axis, angle):
    """A 4 x 4 rotation about an axis."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(angle * np.array(axis)).as_matrix()
    return matrix


def test_grasps_that_failed_are_written_only_where_their_status_is(tmp_path):
    """A plan has them, too, and a robot would play them."""
    hand, one = pinch("allegro")
    rows = [0, 0, 0]
    statuses = [Status.OK, Status.PREGRASP, Status.TIP_ERROR]
    plan = dataclasses.replace(one[rows], status=torch.tensor([int(x) for x in statuses]))
    writers = {
        "isaac": lambda x: format_isaac(hand, x),
        "moveit": lambda x: format_moveit(hand, x),
        "trajectories": lambda x: format_trajectories(hand, x),
        "keyframes": lambda x: format_keyframes(hand, x),
        "bench": lambda x: save_dexgraspbench(hand, x, tmp_path / "bench", "x"),
        "play": lambda x: save_play(hand, x, tmp_path / "play", "mujoco", cylinder()),
    }
    for write in writers.values():
        with pytest.raises(BadArgument, match=r"2 of 3 that failed \(1 \w+, 1 \w+\)"):
            write(plan)
    assert list(tmp_path.iterdir()) == []
    for write in writers.values():
        write(plan.executable)
        write(plan.best)
    told = json.loads(format_grasps(hand, plan))["grasps"]
    assert [x["status"] for x in told] == [x.name for x in statuses]
    assert json.loads(format_graspgen(plan, "x"))["grasps"]["object_in_gripper"] == [
        True,
        False,
        False,
    ]


def menagerie_tips(qpos):
    """Distal frames of index and thumb by the numbers of MuJoCo Menagerie's right Allegro hand, its
    palm turned.
    """
    start = pose(qpos[:3], qpos[3:7]) @ pose([0, 0, 0], [0, 1, 0, 1])
    q = qpos[7:]
    index = (
        start @ pose([0, 0.0435, -0.001542], [0.999048, -0.0436194, 0, 0]) @ turned([0, 0, 1], q[0])
    )
    for height, angle in zip((0.0164, 0.054, 0.0384), q[1:4], strict=True):
        index = index @ pose([0, 0, height], [1, 0, 0, 0]) @ turned([0, 1, 0], angle)
    thumb = start @ pose(
        [-0.0182, 0.019333, -0.045987], [0.477714, -0.521334, -0.521334, -0.477714]
    )
    thumb = thumb @ turned([-1, 0, 0], q[12])
    thumb = thumb @ pose([-0.027, 0.005, 0.0399], [1, 0, 0, 0]) @ turned([0, 0, 1], q[13])
    for height, angle in zip((0.0177, 0.0514), q[14:16], strict=True):
        thumb = thumb @ pose([0, 0, height], [1, 0, 0, 0]) @ turned([0, 1, 0], angle)
    return index, thumb


def link_in_object(hand, grasp, joints, name):
    """A link's frame in the object's frame, by the library."""
    index = hand.tree.link_names.index(name)
    return (grasp.obj_from_hand[0] @ hand.link_poses(joints)[0, index]).numpy()


def test_dexgraspbench_reads_its_fields_and_its_model_stands_where_ours_does(tmp_path):
    hand, grasp = pinch("allegro")
    (path,) = save_dexgraspbench(hand, grasp, tmp_path / "cup", "assets/object/cup", 5.0)
    content = np.load(path, allow_pickle=True).item()  # as its evaluator does
    assert path == tmp_path / "cup" / "0.npy" and content["obj_path"] == "assets/object/cup"
    assert content["obj_scale"] == 1.0 and content["obj_pose"].tolist() == [0, 0, 0, 1, 0, 0, 0]
    postures = {
        "pregrasp": grasp.pregrasp,
        "grasp": grasp.joints,
        "squeeze": squeeze(hand, grasp, 5.0, 5.0).joints,
    }
    for name, joints in postures.items():
        qpos = content[f"{name}_qpos"]
        assert qpos.shape == (23,) and qpos.dtype == np.float64
        for found, link in zip(menagerie_tips(qpos), ("index_distal", "thumb_distal"), strict=True):
            np.testing.assert_allclose(
                found, link_in_object(hand, grasp, joints, link), atol=2e-6
            )  # six digits there


def test_a_hand_whose_frames_in_the_bench_are_unknown_is_refused(tmp_path):
    with pytest.raises(BadArgument, match=r"allegro.*barrett"):
        save_dexgraspbench(*pinch("barrett"), tmp_path, "x")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_moveit_gets_postures_pose_approach_and_quality(name):
    hand, grasp = pinch(name)
    (message,) = yaml.safe_load(format_moveit(hand, grasp, 5.0))
    squeezed = squeeze(hand, grasp, 5.0)
    assert message["grasp_quality"] == pytest.approx(float(grasp.success[0]), abs=1e-9)
    opened = message["pre_grasp_posture"]
    closed = message["grasp_posture"]
    order = opened["joint_names"]
    assert order == closed["joint_names"] == list(hand.tree.joint_names)
    for points, joints in (
        (opened["points"][0], grasp.pregrasp),
        (closed["points"][0], grasp.joints),
    ):
        expected = hand.expand(joints)
        assert points["positions"] == pytest.approx(
            [float(expected[joint][0]) for joint in order], abs=1e-9
        )
        assert points["effort"] == []
    torque = dict(zip(hand.joint_names, squeezed.torques[0].tolist(), strict=True))
    assert closed["points"][1]["effort"] == pytest.approx(
        [torque.get(joint, 0.0) for joint in order], abs=1e-9
    )
    assert closed["points"][1]["time_from_start"] == {"sec": 0, "nanosec": 800_000_000}
    place = message["grasp_pose"]["pose"]["position"]
    q = message["grasp_pose"]["pose"]["orientation"]
    found = pose([place[k] for k in "xyz"], [q[k] for k in "wxyz"])
    np.testing.assert_allclose(found, grasp.obj_from_hand[0], atol=1e-8)
    vectors = [
        message[key]["direction"]["vector"]
        for key in ("pre_grasp_approach", "post_grasp_retreat", "post_place_retreat")
    ]
    there, back, leave = (np.array([v[k] for k in "xyz"]) for v in vectors)
    np.testing.assert_allclose(there, grasp.approach[0], atol=1e-8)
    np.testing.assert_array_equal(leave, -there)  # without the object
    np.testing.assert_array_equal(back, [0, 0, 1])  # up, off the table of the pinch
    for key in ("pre_grasp_approach", "post_grasp_retreat", "post_place_retreat"):
        assert message[key]["min_distance"] < message[key]["desired_distance"] == 0.1
    assert message["grasp_pose"]["header"] == {"frame_id": "object"} and message[
        "allowed_touch_objects"
    ] == ["object"]


def test_every_number_of_the_yaml_is_a_number_and_graspgen_finds_transforms_and_mask():
    hand, grasp = pinch("allegro")
    opened = torch.full_like(grasp.pregrasp, 1e-12).clamp(hand.lower, hand.upper)
    tiny = dataclasses.replace(grasp, pregrasp=opened, score=torch.tensor([-40.0]))
    (message,) = yaml.safe_load(format_moveit(hand, tiny))
    assert all(isinstance(x, float) for x in message["pre_grasp_posture"]["points"][0]["positions"])
    assert message["grasp_quality"] == 0.0
    _, grasp = pinch("allegro")
    lost = dataclasses.replace(grasp, status=torch.tensor([21]))
    content = json.loads(format_graspgen(lost, "cup/mesh.obj"))
    assert content["object"] == {"file": "cup/mesh.obj", "scale": 1.0}
    np.testing.assert_array_equal(content["grasps"]["transforms"], grasp.obj_from_hand.numpy())
    assert content["grasps"]["object_in_gripper"] == [False]


def test_joints_of_other_names_are_refused():
    """Another hand of this name may have as many joints, in another order."""
    hand, grasp = pinch("barrett")
    for given in (hand.joint_names[::-1], ("a", *hand.joint_names[1:])):
        other = dataclasses.replace(grasp, meta=grasp.meta | {"joint_names": ",".join(given)})
        with pytest.raises(BadArgument, match=f"the joints {given[0]}"):
            format_moveit(hand, other)
    few = dataclasses.replace(grasp, meta={"joint_names": "a,b"})
    with pytest.raises(BadArgument, match="a name for each joint"):
        format_graspgen(few, "jug.obj")
    nameless = dataclasses.replace(grasp, meta={})
    assert json.loads(format_graspgen(nameless, "jug.obj"))["joint_names"] == []


def test_a_trajectory_each_goes_from_pregrasp_to_squeeze():
    hand, grasp = pinch("barrett")
    two = grasp[torch.tensor([0, 0])]
    documents = list(yaml.safe_load_all(format_trajectories(hand, two, 5.0)))
    assert len(documents) == 2 and documents[0] == documents[1]
    times = [
        p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"]
        for p in documents[0]["points"]
    ]
    assert times == pytest.approx([0.4, 0.8, 1.2])
    last = hand.expand(squeeze(hand, grasp, 5.0).joints)
    found = documents[0]["points"][2]["positions"]
    assert found == pytest.approx(
        [float(last[joint][0]) for joint in documents[0]["joint_names"]], abs=1e-9
    )
    none = grasp[torch.zeros(0, dtype=torch.int64)]
    assert yaml.safe_load(format_moveit(hand, none)) == []


def test_imported_grasps_are_written_though_the_pads_do_not_prove_closure_but_planned_ones_are_not():
    hand, one = pinch("barrett")
    imported = grasps_from_joints(hand, one.joints, one.obj_from_hand)
    assert imported.status.tolist() == [int(Status.NOT_CLOSED)]
    assert yaml.safe_load(format_isaac(hand, imported))["grasps"]
    planned = dataclasses.replace(imported, meta=imported.meta | {"seed": "0"})
    with pytest.raises(BadArgument, match="1 of 1 that failed"):
        format_isaac(hand, planned)


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_grasps_of_joints_alone_have_contacts_certificates_and_a_pregrasp(name):
    hand, planned = pinch(name)
    grasps = grasps_from_joints(hand, planned.joints, planned.obj_from_hand, std_m=0.003)
    gap = (grasps.contacts.points - planned.contacts.points).norm(dim=-1)
    assert (
        float(gap.max()) < 0.012
    )  # the planned ones are where a sphere touches, off the middle of the pad
    proved = certify(grasps.contacts).closed
    assert proved.tolist() == [
        name == "allegro"
    ]  # the Barrett hand's pads stand up to 50 degrees off the cylinder
    assert grasps.status.tolist() == [int(Status.OK if proved else Status.NOT_CLOSED)]
    radial = grasps.contacts.normals[0, :, :2] * planned.contacts.normals[0, :, :2]
    assert bool((radial.sum(-1) > 0.6).all())  # outward, as the cylinder's
    opened = hand.fingertips(grasps.pregrasp)[0] - hand.fingertips(grasps.joints)[0]
    outward = -hand.fingertips(grasps.joints)[1]
    assert bool(((opened * outward).sum(-1) > (0.01 if name == "allegro" else 0.001)).all())
    squeezed = squeeze(hand, grasps, 4.0)
    assert bool(torch.isfinite(squeezed.joints).all())


def test_joints_with_poses_in_millimetres_or_an_impossible_table_are_refused():
    hand, planned = pinch("barrett")
    joints = planned.joints
    pose = planned.obj_from_hand
    far = pose.clone()
    far[:, :3, 3] *= 1000
    with pytest.raises(BadArgument, match="obj_from_hand: expected poses within 10 m, in metres"):
        grasps_from_joints(hand, joints, far)
    assert len(grasps_from_joints(hand, joints, pose, table=Plane.horizontal(0.0))) == 1
    down = Plane(torch.tensor([0.0, 0.0, -1.0]), 0.0)
    for table in (Plane.horizontal(0.5), Plane.horizontal(-150.0), down):
        with pytest.raises(BadArgument, match="table: expected the table under the object"):
            grasps_from_joints(hand, joints, pose, table=table)
    assert len(grasps_from_joints(hand, joints[:0], pose[:0], table=down)) == 0


def test_our_json_and_dexgraspbench_come_back_to_the_same_grasps(tmp_path):
    hand, grasp = pinch("barrett")
    file = tmp_path / "grasps.json"
    file.write_text(format_grasps(hand, grasp))
    read = read_foreign(file, hand)
    torch.testing.assert_close(read.joints, grasp.joints)
    torch.testing.assert_close(read.pregrasp, grasp.pregrasp)
    near(read.obj_from_hand, grasp.obj_from_hand, 1e-9)
    hand, grasp = pinch("allegro")
    # the left hand has the same names of joints and links, and the same limits of most joints
    file.write_text(format_grasps(hand, grasp))
    with pytest.raises(ModelFileError, match="expected grasps of the allegro_left hand"):
        read_foreign(file, load_hand("allegro_left"))
    (path,) = save_dexgraspbench(hand, grasp, tmp_path, "x")
    content = np.load(path, allow_pickle=True).item()
    np.savez(tmp_path / "grasps.npz", **content)
    read = read_foreign(tmp_path / "grasps.npz", hand)
    torch.testing.assert_close(read.joints, grasp.joints)
    torch.testing.assert_close(read.pregrasp, grasp.pregrasp)
    near(read.obj_from_hand, grasp.obj_from_hand, 1e-9)


def test_multigrippergrasp_needs_the_order_of_its_joints(tmp_path):
    hand, grasp = pinch("barrett")
    w, x, y, z = Rotation.from_matrix(grasp.obj_from_hand[0, :3, :3].numpy()).as_quat()[
        [3, 0, 1, 2]
    ]
    place = grasp.obj_from_hand[0, :3, 3].tolist()
    order = ("f3_flex", "other", "spread", "f2_flex", "f1_flex")
    spread, f1, f2, f3 = grasp.joints[0].tolist()
    for quaternion, turn in (("wxyz", [w, x, y, z]), ("xyzw", [x, y, z, w])):
        content = {
            "gripper": "barrett",
            "object_ID": "cup",
            "pose": [place + turn],
            "dofs": [[f3, 9.0, spread, f2, f1]],
        }
        file = tmp_path / "grasps.json"
        file.write_text(json.dumps(content))
        with pytest.warns(GraspFileWarning, match="other"):
            read = read_foreign(file, hand, order, quaternion)
        torch.testing.assert_close(read.joints, grasp.joints)
        near(read.obj_from_hand, grasp.obj_from_hand, 1e-9)
        assert read.pregrasp is None
    for wrong in ((), order[:-1], (*order[:-1], "spread")):
        with pytest.raises(BadArgument, match="order"):
            read_foreign(file, hand, wrong)


@pytest.mark.parametrize(
    "content",
    [
        "[]",
        "{}",
        '{"grasps": 1}',
        '{"grasps": [{}]}',
        '{"pose": [[1]], "dofs": [[1]]}',
        '{"pose": 1, "dofs": 2}',
        "\0",
    ],
)
def test_a_malformed_file_is_refused_by_name(tmp_path, content):
    hand, _ = pinch("barrett")
    file = tmp_path / "grasps.json"
    file.write_text(content)
    with pytest.raises(BadArgument, match="expected "):
        read_foreign(file, hand, hand.joint_names)


def test_poses_of_too_few_numbers_and_an_npz_of_pickles_wrong_shapes_or_nan_are_refused(tmp_path):
    hand, grasp = pinch("allegro")
    content = json.loads(format_grasps(hand, grasp))
    content["grasps"][0]["pose"]["position"].pop()
    (tmp_path / "grasps.json").write_text(json.dumps(content))
    with pytest.raises(BadArgument, match=r"expected 3 numbers.*grasps\[0\]\.pose\.position"):
        read_foreign(tmp_path / "grasps.json", hand)
    hand, _ = pinch("allegro")
    file = tmp_path / "grasps.npz"
    row = np.concatenate([[0, 0, 0, 1, 0, 0, 0], np.zeros(16)])
    bad = [
        {"x": row},
        {"grasp_qpos": row[:-1]},
        {"grasp_qpos": np.array([{}])},
        {"grasp_qpos": row * np.nan},
    ]
    bad += [{"grasp_qpos": row, "pregrasp_qpos": np.stack([row, row])}, {"grasp_qpos": 2 * row}]
    for tables in bad:
        np.savez(file, **tables)
        with pytest.raises(BadArgument, match="expected "):
            read_foreign(file, hand)
    file.write_bytes(b"PK\x03\x04 no archive")
    with pytest.raises(BadArgument, match="expected "):
        read_foreign(file, hand)


def test_the_commands_write_every_format_and_read_them_back(tmp_path, capsys):
    hand, grasp = pinch("allegro")
    meta = {
        "hand": "allegro",
        "hand_sha256": hand.source.sha256,
        "joint_names": ",".join(hand.joint_names),
    }
    grasp = dataclasses.replace(grasp, meta=meta)
    grasp.save(tmp_path / "g.safetensors")
    words = ["export", str(tmp_path / "g.safetensors"), "--format"]
    for kind in ("moveit", "ros2"):
        assert cli.main([*words, kind, "--out", str(tmp_path / kind)]) == 0
        assert (tmp_path / kind).read_text().startswith("# ")
    for kind in ("dexgraspbench", "graspgen"):
        assert cli.main([*words, kind, "--out", str(tmp_path / kind)]) == 2
        assert "--object" in capsys.readouterr().err
        assert (
            cli.main([*words, kind, "--out", str(tmp_path / kind), "--object", "assets/cup"]) == 0
        )
    assert cli.main([*words, "json", "--out", str(tmp_path / "g.json"), "--object", "x"]) == 2
    assert cli.main([*words, "json", "--out", str(tmp_path / "g.json")]) == 0
    capsys.readouterr()
    taken = [
        "import",
        str(tmp_path / "g.json"),
        "--hand",
        "allegro",
        "--out",
        str(tmp_path / "back.safetensors"),
    ]
    assert cli.main(taken) == 0 and "1 closed" in capsys.readouterr().out
    assert (
        cli.main(
            ["export", str(tmp_path / "back.safetensors"), "--out", str(tmp_path / "again.json")]
        )
        == 0
    )
    first, again = (
        json.loads((tmp_path / f).read_text())["grasps"][0] for f in ("g.json", "again.json")
    )
    assert again["joints"]["grasp"] == pytest.approx(first["joints"]["grasp"])


@pytest.fixture
def foreign(tmp_path, capsys):
    """Return a function that imports the pinch in MultiGripperGrasp's format with its view."""
    hand, grasp = pinch("barrett")
    camera = look_at(30.0, 40.0, 0.6, cylinder())
    save_cloud(partial_view(cylinder(), camera, 300), tmp_path / "view.npz")
    x, y, z, w = Rotation.from_matrix(grasp.obj_from_hand[0, :3, :3].numpy()).as_quat()
    position = grasp.obj_from_hand[0, :3, 3].numpy()

    def run(scale, turn, *options, shift=(0, 0, 0), view=True):
        pose = [
            *(scale * (position + shift)).tolist(),
            *((w, x, y, z) if turn == "wxyz" else (x, y, z, w)),
        ]
        (tmp_path / "theirs.json").write_text(
            json.dumps({"pose": [pose], "dofs": grasp.joints.tolist()})
        )
        words = [
            "import",
            str(tmp_path / "theirs.json"),
            "--hand",
            "barrett",
            "--out",
            str(tmp_path / "t.safetensors"),
        ]
        words += [
            "--joints",
            *hand.joint_names,
            *options,
            *(["--cloud", str(tmp_path / "view.npz")] * view),
        ]
        code = cli.main(words)
        return code, "".join(capsys.readouterr()), (tmp_path / "t.safetensors").exists()

    return run


def test_poses_that_contradict_the_view_are_told_with_the_options_that_mend_them(foreign):
    for scale, turn, mend in (
        (1, "xyzw", "--quaternion xyzw --unit m"),
        (100, "wxyz", "--quaternion wxyz --unit cm"),
    ):
        code, words, written = foreign(scale, turn)
        assert (
            code == 2
            and not written
            and f"as with {mend}" in words
            and "contacts within 30 mm" in words
        )
    code, words, written = foreign(1000, "wxyz", view=False)
    assert code == 2 and not written and "a hand 326 m off" in words and "--unit" in words
    code, words, written = foreign(
        1, "wxyz", shift=(0.2, 0, 0)
    )  # another frame, which no option mends
    assert code == 2 and not written and "one frame" in words and "as with" not in words


TWINS = [(1, "wxyz", ()), (1000, "xyzw", ("--quaternion", "xyzw", "--unit", "mm"))]


@pytest.mark.parametrize(("scale", "turn", "options"), TWINS)
def test_poses_that_agree_with_the_view_are_taken(foreign, scale, turn, options):
    code, words, written = foreign(scale, turn, *options)
    assert code == 0 and written and "1 closed" in words
