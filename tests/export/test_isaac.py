"""The isaac_grasp file: its fields by the published pages, its frames in a scene by another chain
of the URDF, a reader of another project, and the way back.
"""

import dataclasses
import json
import math
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
import yourdfpy

from tests.pinch import pinch
from torchgrasp import Plane, load_grasps, load_hand
from torchgrasp.app import cli
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.export import format_isaac, read_foreign
from torchgrasp.foundation.errors import BadArgument, GraspFileWarning, ModelFileError
from torchgrasp.geometry.frames import apply

READER = Path(__file__).parents[2] / ".beside" / "graspgenx" / "bin" / "python"
HANDS = ("allegro", "barrett")
KEYS = {"confidence", "position", "orientation", "cspace_position", "pregrasp_cspace_position"}
"""The fields of a grasp that the published pages list."""


def written(tmp_path, name="barrett", **options):
    """The hand, its grasp of the jug, and the file of it."""
    hand = load_hand(name)
    grasp = load_shipped_grasp("jug", name)
    path = tmp_path / "grasps.yaml"
    path.write_text(format_isaac(hand, grasp, **options))
    return hand, grasp, path


def matrix(position, w, xyz):
    """A pose (4, 4) by the textbook formula of a quaternion."""
    x, y, z = xyz
    pose = np.eye(4)
    pose[:3, 3] = position
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return pose


def is_number(value, low=-math.inf, high=math.inf):
    return type(value) is float and math.isfinite(value) and low <= value <= high


@pytest.mark.parametrize("name", HANDS)
@pytest.mark.parametrize("isaac_ros", [False, True])
def test_each_field_is_what_the_published_pages_say(tmp_path, name, isaac_ros):
    hand, grasp, path = written(
        tmp_path, name, object_id="/World/jug", gripper_link="/World/hand", isaac_ros=isaac_ros
    )
    content = yaml.safe_load(path.read_text())
    frames = ["object_frame", "gripper_frame"]
    if not isaac_ros:
        frames = [f"{frame}_link" for frame in frames]
    assert list(content) == ["format", "format_version", *frames, "grasps"]
    assert content["format"] == "isaac_grasp" and content["format_version"] == 1.0
    assert [content[frame] for frame in frames] == ["/World/jug", "/World/hand"]
    (one,) = content["grasps"].values()
    assert set(one) == KEYS | {"squeeze_cspace_position"}
    assert one["confidence"] == pytest.approx(float(grasp.success[0]), abs=1e-12)
    assert len(one["position"]) == 3 and all(map(is_number, one["position"]))
    turn = [one["orientation"]["w"], *one["orientation"]["xyz"]]
    assert len(turn) == 4 and all(is_number(x, -1, 1) for x in turn)
    assert np.linalg.norm(turn) == pytest.approx(1.0, abs=1e-12)
    for key in set(one) - {"confidence", "position", "orientation"}:
        assert set(one[key]) == set(hand.tree.joint_names) and all(
            map(is_number, one[key].values())
        )


def test_an_unknown_success_is_confidence_0():
    grasp = load_shipped_grasp("jug", "barrett")
    grasp = dataclasses.replace(grasp, known=torch.zeros(1, dtype=torch.bool))
    assert math.isnan(float(grasp.success[0]))
    text = format_isaac(load_hand("barrett"), grasp)
    assert yaml.safe_load(text)["grasps"]["grasp_0"]["confidence"] == 0.0


@pytest.mark.parametrize("name", HANDS)
def test_in_a_scene_the_fingertips_stand_on_the_contacts_of_the_plan(tmp_path, name):
    """The object stands anywhere in the world; the hand's link is put where the file says, its
    joints by name.
    """
    link = {"allegro": "thumb_distal", "barrett": "palm"}[name]
    hand, grasp, path = written(tmp_path, name, gripper_link=f"/World/{name}/{link}")
    (one,) = yaml.safe_load(path.read_text())["grasps"].values()
    world_from_object = matrix([0.4, -0.2, 0.7], 0.1, [0.7, -0.1, 0.7])
    object_from_link = matrix(one["position"], one["orientation"]["w"], one["orientation"]["xyz"])
    chain = yourdfpy.URDF.load(
        str(hand.urdf_path), load_meshes=False, load_collision_meshes=False, build_scene_graph=True
    )
    # as yourdfpy takes them: joints that follow get their values by its own rule
    chain.update_cfg({x: one["cspace_position"][x] for x in chain.actuated_joint_names})
    world_from_link = world_from_object @ object_from_link
    root_from_link = chain.get_transform(link)
    points = grasp.contacts.points[0].numpy() @ world_from_object[:3, :3].T
    points += world_from_object[:3, 3]
    normals = grasp.contacts.normals[0].numpy() @ world_from_object[:3, :3].T
    radii = np.linalg.norm(hand.tips.contact.numpy(), axis=1)
    for row, tip in enumerate(hand.tips.links):
        pose = world_from_link @ np.linalg.inv(root_from_link) @ chain.get_transform(tip)
        # a fingertip is a ball about the origin of its link, which rests on the contact
        off = np.linalg.norm(pose[:3, 3] - points[row] - radii[row] * normals[row])
        assert off < float(grasp.tip_error[0, row]) + 1e-5


@pytest.mark.parametrize("name", HANDS)
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"actuated": True},
        {"isaac_ros": True, "gripper_link": "/World/hand/{link}"},
        {"flange": True, "gripper_link": "tool0"},
    ],
)
def test_what_is_written_comes_back(tmp_path, name, options):
    hand = load_hand(name)
    options = {**options}
    root = ""
    if "flange" in options:
        options["flange"] = torch.from_numpy(matrix([0.01, 0.0, -0.05], 0.6, [0.0, 0.8, 0.0]))
        root = options["flange"].inverse()
    if "gripper_link" in options:
        options["gripper_link"] = options["gripper_link"].format(link=hand.tree.link_names[-1])
    hand, grasp, path = written(tmp_path, name, **options)
    read = read_foreign(path, hand, root=root)
    assert torch.equal(read.joints, grasp.joints.double())
    assert read.pregrasp is not None and torch.equal(read.pregrasp, grasp.pregrasp.double())
    torch.testing.assert_close(
        read.obj_from_hand, grasp.obj_from_hand.double(), rtol=0.0, atol=2e-15
    )
    assert read.table is None


def test_a_flange_has_the_name_of_a_link_only_where_this_link_is(tmp_path):
    """A reader takes poses under the name of a link for poses of this link."""
    hand, grasp = pinch("barrett")
    flange = torch.from_numpy(matrix([0.01, 0.0, -0.05], 0.6, [0.0, 0.8, 0.0]))
    for name in ("palm", "/World/barrett/palm"):
        with pytest.raises(BadArgument, match=r"gripper_link.*not where the flange is"):
            format_isaac(hand, grasp, flange=flange, gripper_link=name)
    still = torch.eye(4, dtype=torch.float64)
    text = format_isaac(hand, grasp, flange=still, gripper_link="palm")
    assert yaml.safe_load(text) == yaml.safe_load(format_isaac(hand, grasp))


def test_joints_that_follow_are_left_out_on_demand_and_names_are_the_robots(tmp_path):
    hand, _, path = written(tmp_path, actuated=True, rename={"spread": "right_spread"})
    (one,) = yaml.safe_load(path.read_text())["grasps"].values()
    for key in KEYS - {"confidence", "position", "orientation"}:
        assert set(one[key]) == {"right_spread", "f1_flex", "f2_flex", "f3_flex"}
    text = path.read_text()
    path.write_text("".join(x for x in text.splitlines(True) if "names here" not in x))
    with pytest.raises(ModelFileError, match=r"grasp_0\.cspace_position with 'right_spread'"):
        read_foreign(path, hand)


@pytest.mark.parametrize(
    "names",
    [
        {"joint_0": "joint_1", "joint_1": "joint_0"},  # of another numbering of the same hand
        {"joint_12": "joint_0", "joint_0": "thumb\n1", "joint_9": "9"},
    ],
)
def test_a_file_with_the_names_of_a_robot_comes_back(tmp_path, names):
    hand, grasp, path = written(tmp_path, "allegro", rename=names)
    read = read_foreign(path, hand)
    np.testing.assert_allclose(read.joints, grasp.joints, atol=1e-9)
    np.testing.assert_allclose(read.pregrasp, grasp.pregrasp, atol=1e-9)
    good = json.dumps(names)
    for wrong in ("[1]", "{", '{"wrist": "a"}', '{"joint_0": 3}', '{"joint_0": "joint_1"}'):
        path.write_text(format_isaac(hand, grasp, rename=names).replace(good, wrong))
        with pytest.raises(ModelFileError):
            read_foreign(path, hand)


EDITOR = """
format: isaac_grasp
format_version: "1.0"

object_frame: /World/jug
gripper_frame: /World/barrett/palm
created_with: an editor

grasps:
   "grasp_0":
      confidence: 1.0
      position: [-46.5, 0, 1e-05]
      orientation: {w: "0.6", xyz: [0.8, 0.0, 1.1850312539909822e-16]}
      cspace_position:
         spread: 0
         f1_flex: 1
         f2_flex: 1.0
         f3_flex: 1.1

   "grasp_1":
      confidence: 0.0
      position: [0.0, 0.0, 1.0]
      orientation: {w: -1.0, xyz: [0.0, 0.0, 0.0]}
      cspace_position: {spread: .1, f1_flex: 1., f2_flex: 1.0, f3_flex: 1.1}
"""


def test_a_file_of_an_editor_is_read_and_what_is_not_kept_is_told(tmp_path):
    """Numbers in quotes or without a point are numbers, as Isaac Sim reads them."""
    path = tmp_path / "editor.yml"
    path.write_text(EDITOR)
    hand = load_hand("barrett")
    with pytest.warns(GraspFileWarning, match=r"editor\.yml: not read: created_with"):
        read = read_foreign(path, hand, unit_m=0.001)
    assert read.joints.tolist() == [[0.0, 1.0, 1.0, 1.1], [0.1, 1.0, 1.0, 1.1]]
    assert read.pregrasp is None
    np.testing.assert_allclose(
        read.obj_from_hand[0], matrix([-0.0465, 0, 1e-8], 0.6, [0.8, 0.0, 0.0]), atol=1e-15
    )
    np.testing.assert_allclose(read.obj_from_hand[1], matrix([0, 0, 0.001], 1.0, [0.0] * 3))


POSTURE = EDITOR[EDITOR.index("      cspace_position:\n") : EDITOR.index('   "grasp_1"')]
WRONG = {
    "version": ('"1.0"', "2.0", r"expected 1\.0, got .*format_version = 2\.0"),
    "format": ("isaac_grasp\n", "other\n", r"expected isaac_grasp, got .*format = 'other'"),
    "unknown joint": ("spread: 0\n", "wrist: 0\n", r"joints of the barrett hand: spread.*'wrist'"),
    "missing joint": ("         f1_flex: 1\n", "", r"an object with 'f1_flex'"),
    "no joints": (POSTURE, "", r"an object with 'cspace_position'"),
    "length": ('w: "0.6"', "w: 0.7", r"length 1, got pose 0 with a quaternion of length 1\.06"),
    "three numbers": ("[0.8, 0.0, ", "[0.8, ", r"expected 3 numbers, got .*orientation\.xyz"),
    "confidence": ("confidence: 1.0", "confidence: 1.5", r"\[0, 1\], got .*confidence = 1\.5"),
    "no number": ("spread: 0\n", "spread: .nan\n", r"a number in .* got .*spread = '\.nan'"),
    "frame": ("barrett/palm", "barrett/wrist", r"--root.*got poses of the link wrist"),
    "twice": ('"grasp_1"', '"grasp_0"', r"grasp_0 twice"),
    "alias": ("confidence: 1.0", "confidence: &a 1.0\n      more: *a", r"an alias"),
    "pregrasp": (
        ".1}",
        ".1}\n      pregrasp_cspace_position: {}",
        r"none, got .* some grasps only",
    ),
    "malformed": ("format:", "format: [", r"expected an isaac_grasp file of version 1\.0"),
    "document": ("format:", "---\na: 1\n---\nformat:", r"a second document"),
    "follower": ("spread: 0\n", "spread: 0\n         f1_distal: 1\n", r"f1_distal at 1, .*f1_flex"),
}
"""What a part of the file becomes, and the words that refuse it."""


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_file_is_refused_by_what_is_wrong(tmp_path, case):
    old, new, words = WRONG[case]
    assert old in EDITOR
    path = tmp_path / "wrong.yaml"
    path.write_text(EDITOR.replace(old, new, 1).replace("created_with: an editor\n", ""))
    with pytest.raises(ModelFileError, match=words) as told:
        read_foreign(path, load_hand("barrett"))
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("text", ["", "[" * 100_000, "- 1", "a: " + "{b: " * 20 + "}" * 20])
def test_no_text_ends_python(tmp_path, text):
    path = tmp_path / "wrong.yaml"
    path.write_text(text)
    with pytest.raises(ModelFileError):
        read_foreign(path, load_hand("barrett"))


def test_another_project_reads_poses_and_confidences(tmp_path):
    if not READER.exists():
        pytest.skip("scripts/beside graspgenx makes the environment of the reader")
    _, grasp, path = written(tmp_path, "allegro")
    code = (
        "import json, sys; from graspgenx.dataset.eval_utils import load_from_isaac_grasp_format; "
        "print(json.dumps([x.tolist() for x in load_from_isaac_grasp_format(sys.argv[1])]))"
    )
    command = [str(READER), "-c", code, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, env={"PYTHONPATH": ""})
    assert done.returncode == 0, done.stderr[-3000:]
    poses, confidences = json.loads(done.stdout.splitlines()[-1])
    np.testing.assert_allclose(poses, grasp.obj_from_hand.double(), atol=1e-12)
    np.testing.assert_allclose(confidences, grasp.success.double(), atol=1e-12)


def test_the_command_line_writes_the_file_and_reads_it(tmp_path, capsys):
    grasp = load_shipped_grasp("jug", "barrett")
    grasp.save(tmp_path / "g.safetensors")
    out = tmp_path / "jug.yaml"
    frames = ["--object", "/World/jug", "--gripper-link", "/World/barrett/f1_tip", "--isaac-ros"]
    command = ["export", str(tmp_path / "g.safetensors"), "--format", "isaac", "--out", str(out)]
    assert cli.main([*command, *frames]) == 0
    assert "spread_mimic" in capsys.readouterr().out  # a follower that is written, told
    back = tmp_path / "back.safetensors"
    assert cli.main(["import", str(out), "--hand", "barrett", "--out", str(back)]) == 0
    read = load_grasps(back)
    assert torch.equal(read.joints, grasp.joints.double())
    np.testing.assert_allclose(read.obj_from_hand, grasp.obj_from_hand.double(), atol=2e-15)
    text = out.read_text().replace("1.0", "1.1", 1)
    out.write_text(text)
    assert cli.main(["import", str(out), "--hand", "barrett", "--out", str(back)]) == 2
    assert "format_version" in capsys.readouterr().err
    wrong = [*command[:3], "moveit", "--out", str(out), "--isaac-ros"]
    assert cli.main(["export", str(tmp_path / "g.safetensors"), "--format", *wrong[3:]]) == 2
    assert "--isaac-ros" in capsys.readouterr().err


def test_a_hand_that_goes_down_while_it_closes_is_left_out_and_told(tmp_path, capsys):
    """Of two grasps, the one whose opened hand is 5 mm in the table."""
    hand = load_hand("barrett")
    grasp = load_shipped_grasp("jug", "barrett")
    centres = apply(grasp.obj_from_hand, hand.sphere_centres(grasp.pregrasp))[0, :, 2]
    lowest = (centres - hand.collision_spheres.radius).min()
    table = Plane.horizontal(float(lowest) + 0.005)
    higher = grasp.obj_from_hand.clone()
    higher[:, 2, 3] += 0.02
    both = grasp[[0, 0]]
    poses = torch.cat([grasp.obj_from_hand, higher])
    meta = grasp.meta | {"table": table.describe()}
    points = both.contacts.points.clone()
    points[1, :, 2] += 0.02
    contacts = dataclasses.replace(both.contacts, points=points)
    both = dataclasses.replace(both, obj_from_hand=poses, contacts=contacts, meta=meta)
    both.save(tmp_path / "g.safetensors")
    for kind in ("isaac", "moveit"):
        out = tmp_path / f"{kind}.yaml"
        command = ["export", str(tmp_path / "g.safetensors"), "--format", kind, "--out", str(out)]
        assert cli.main(command) == 0
        assert "1 of 2 grasps are left out" in capsys.readouterr().out
    grasps = yaml.safe_load((tmp_path / "isaac.yaml").read_text())["grasps"]
    assert [x["position"][2] for x in grasps.values()] == [float(higher[0, 2, 3])]


def test_a_file_of_another_hand_is_refused_by_its_name_and_one_without_is_told(tmp_path):
    """The left hand has the joints and links of the right one, so that nothing else tells."""
    path = tmp_path / "hands.yaml"
    right, grasp = pinch("allegro")
    left = load_hand("allegro_left")
    text = format_isaac(right, grasp)
    path.write_text(text)
    read = read_foreign(path, right)
    torch.testing.assert_close(read.joints, grasp.joints.double(), atol=1e-9, rtol=0.0)
    with pytest.raises(ModelFileError, match=r"of the allegro_left hand, .* of the allegro hand"):
        read_foreign(path, left)
    unnamed = text[text.index("format:") :]
    path.write_text(unnamed)
    for hand in (right, left):
        with pytest.warns(GraspFileWarning, match=rf"names no hand, .* of the {hand.name} hand"):
            read_foreign(path, hand)
    frame = yaml.safe_load(text)["gripper_frame_link"]
    path.write_text(unnamed.replace(f"link: {frame}", f"link: /World/allegro/{frame}"))
    assert torch.equal(read_foreign(path, right).joints, read.joints)
