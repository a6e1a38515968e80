"""The stages for MoveIt Task Constructor without ROS: a stand-in plays what its published Python
bindings do, and the fingertips end on the contacts of the plan.
"""

import copy
import dataclasses
from types import SimpleNamespace

import mtc_stage
import numpy as np
import pytest
import torch
import yourdfpy
from messages import read_pose

from tests.ros2 import bags
from torchgrasp import load_hand
from torchgrasp.data.shipped import load_shipped_grasp

WORLD_FROM_OBJECT = read_pose([0.5, -0.1, 0.3], [0.1, 0.7, -0.1, 0.7])
ROBOT = mtc_stage.Robot("arm", "hand", "hand_eef", "palm", ("palm", "thumb_tip"))
JOINTS = load_hand("allegro").tree.joint_names


class Properties(dict):
    """Takes what the bindings convert: plain values, and messages of registered types."""

    registered = ("PoseStamped",)

    def __setitem__(self, name, value):
        kind = type(value).__name__.rpartition("__")[2]
        if kind not in ("str", "float", "int", "bool", *self.registered):
            raise TypeError(f"No C++ conversion available for (property) type: {kind}")
        super().__setitem__(name, value)

    def configureInitFrom(self, source, names):
        self.sources = {name: source for name in names}


class Part:
    """A stage; what is given to another belongs to it, and can no longer be set."""

    def __init__(self, name):
        assert isinstance(name, str)
        self.name = name
        self.properties = Properties()

    def __setattr__(self, name, value):
        if "owner" in self.__dict__ and name != "pending":
            raise ValueError("missing value for wrapped C++ type: disowned")
        super().__setattr__(name, value)

    def given(self):
        self.owner = True
        return self


class Container(Part):
    def __init__(self, name):
        super().__init__(name)
        self.children = []

    def add(self, *stages):
        self.children += [stage.given() for stage in stages]


class Generator(Part):
    def __init__(self, name):
        super().__init__(name)
        self.spawned = []

    def init(self, robot_model):
        assert robot_model.get_joint_model_group

    def reset(self):
        self.spawned.clear()

    def setMonitoredStage(self, stage):
        assert isinstance(stage, Part)
        self.monitored = stage

    def spawn(self, state, cost):
        assert isinstance(state, State) and type(cost) is float and np.isfinite(cost)
        self.spawned.append((state, cost))


class State:
    def __init__(self, scene):
        assert isinstance(scene, Scene)
        self.scene = scene
        self.properties = Properties()


class ComputeIK(Part):
    def __init__(self, name, stage):
        super().__init__(name)
        self.generator = stage.given()


class Move(Part):
    def __init__(self, name, planner):
        super().__init__(name)

    def setGoal(self, goal):
        bags.through_cdr(goal, "moveit_msgs/RobotState")
        assert goal.is_diff  # otherwise attached objects are lost
        self.goal = goal

    def setDirection(self, direction):
        self.direction = bags.through_cdr(direction, "geometry_msgs/Vector3Stamped")


class Modify(Part):
    def allowCollisions(self, first, second, enable):
        assert isinstance(first, str) and isinstance(second, list) and enable is True
        self.allowed = first, second

    def attachObject(self, name, link):
        self.attached = name, link


class Scene:
    """A planning scene: its state is a copy, as older bindings give it."""

    def __init__(self, frames):
        self.frames = frames
        self._state = {name: 0.0 for name in JOINTS}

    def __copy__(self):
        other = Scene(self.frames)
        other._state = dict(self._state)
        return other

    def knows_frame_transform(self, frame):
        return frame in self.frames

    @property
    def current_state(self):
        return SimpleNamespace(joint_positions=dict(self._state), update=lambda: None)

    @current_state.setter
    def current_state(self, state):
        assert all(type(x) is float for x in state.joint_positions.values())
        self._state |= state.joint_positions


class Model:
    """A robot whose hand has joints of these names."""

    def __init__(self, joints=JOINTS, group="hand"):
        self.groups = {group: SimpleNamespace(joint_model_names=list(joints))}

    def has_joint_model_group(self, name):
        return name in self.groups

    def get_joint_model_group(self, name):
        return self.groups[name]


CORE = SimpleNamespace(
    MonitoringGenerator=Generator,
    InterfaceState=State,
    Alternatives=Container,
    SerialContainer=Container,
    CartesianPath=object,
    JointInterpolationPlanner=object,
    Stage=SimpleNamespace(PropertyInitializerSource=SimpleNamespace(INTERFACE="interface")),
)
STAGES = SimpleNamespace(
    ComputeIK=ComputeIK, MoveTo=Move, MoveRelative=Move, ModifyPlanningScene=Modify
)


def generate(stage, scene, model=None):
    """The interface states and costs of a generator, as a task asks for them."""
    stage.init(Model() if model is None else model)
    stage.reset()
    stage.onNewSolution(SimpleNamespace(end=SimpleNamespace(scene=scene)))
    while stage.canCompute():
        stage.compute()
    return stage.spawned


def play(sequence, scene):
    """Pose of the hand's frame in the world and joints after each stage of a sequence."""
    approach, reach, touch, *moves, hold = sequence.children
    assert approach.group == "arm" and 0 < approach.min_distance < approach.max_distance
    ((state, cost),) = generate(reach.generator, scene)
    assert reach.properties.sources == {"target_pose": "interface"} and reach.eef == "hand_eef"
    assert reach.ik_frame.header.frame_id == "palm"
    target = state.properties["target_pose"]
    place, turn = target.pose.position, target.pose.orientation
    pose = scene.frames[target.header.frame_id] @ read_pose(
        [place.x, place.y, place.z], [turn.x, turn.y, turn.z, turn.w]
    )
    joints = [state.scene.current_state.joint_positions]
    assert touch.allowed == ("jug", ["palm", "thumb_tip"]) and hold.attached == ("jug", "palm")
    for move in moves:
        goal = move.goal.joint_state
        assert move.group == "hand"
        joints.append(joints[-1] | dict(zip(goal.name, goal.position.tolist(), strict=True)))
    return pose, joints, cost


@pytest.fixture
def grasp():
    return load_shipped_grasp("jug", "allegro")


@pytest.fixture
def file(grasp, tmp_path):
    """The grasp as the planner saves it."""
    grasp.save(tmp_path / "grasps.safetensors")
    return tmp_path / "grasps.safetensors"


def read(file, folder, frame="jug"):
    """The messages of a file, back from an .mcap file."""
    found = mtc_stage.load_grasps(bags.types(), file, frame, bags.time(7), "jug")
    return bags.through_mcap(folder, "moveit_msgs/Grasp", *found)


@pytest.mark.parametrize("press", [True, False])
def test_a_played_task_ends_with_the_fingertips_on_the_contacts(file, grasp, tmp_path, press):
    hand = load_hand("allegro")
    states = mtc_stage.read_states(bags.types(), read(file, tmp_path / "a"))
    current = Part("current")
    task = mtc_stage.pick(bags.types(), CORE, STAGES, current, states, ROBOT, "jug", press=press)
    scene = Scene({"jug": WORLD_FROM_OBJECT})
    (sequence,) = task.children
    pose, postures, cost = play(sequence, scene)
    assert len(postures) == 2 + press and cost == pytest.approx(1 - float(grasp.success[0]))
    opened = hand.expand_joints(grasp.pregrasp)[0].tolist()
    assert postures[0] == pytest.approx(dict(zip(JOINTS, opened, strict=True)), abs=1e-8)
    assert scene.current_state.joint_positions == dict.fromkeys(JOINTS, 0.0)  # not the task's own
    # the contacts, where the object stands; a fingertip is a ball about its link's origin
    chain = yourdfpy.URDF.load(
        str(hand.urdf_path), load_meshes=False, load_collision_meshes=False, build_scene_graph=True
    )
    chain.update_cfg({name: postures[1][name] for name in chain.actuated_joint_names})
    radii = np.linalg.norm(hand.tips.contact.numpy(), axis=1)
    points = grasp.contacts.points[0] + torch.tensor(radii)[:, None] * grasp.contacts.normals[0]
    for tip, point in zip(hand.tips.links, points.numpy(), strict=True):
        wanted = WORLD_FROM_OBJECT[:3, :3] @ point + WORLD_FROM_OBJECT[:3, 3]
        found = (pose @ chain.get_transform(tip))[:3, 3]
        assert np.abs(found - wanted).max() < 1e-5
    if press:
        assert max(abs(postures[2][name] - postures[1][name]) for name in JOINTS) > 1e-3


@pytest.mark.parametrize("registered", [("PoseStamped",), ("PoseStamped", "RobotState")])
def test_one_stage_offers_all_grasps_the_best_first(file, tmp_path, monkeypatch, registered):
    """Where the bindings take a RobotState as a property, SimpleGrasp finds the postures, too."""
    monkeypatch.setattr(Properties, "registered", registered)
    (first,) = read(file, tmp_path / "a")
    second = dataclasses.replace(first, id="second", grasp_quality=0.99)
    states = mtc_stage.read_states(bags.types(), [first, second])
    assert [state.name for state in states] == ["second", "grasp_0"]
    stage = mtc_stage.make_stage(CORE, states, "hand")
    spawned = generate(stage, Scene({"jug": WORLD_FROM_OBJECT}))
    assert [cost for _, cost in spawned] == sorted(state.cost for state in states)
    for state, _ in spawned:
        properties = state.properties
        bags.through_cdr(properties["target_pose"], "geometry_msgs/PoseStamped")
        names = [name for name in mtc_stage.POSTURES if name in properties]
        assert names == (list(mtc_stage.POSTURES) if "RobotState" in registered else [])
        for name in names:
            posture = bags.through_cdr(properties[name], "moveit_msgs/RobotState")
            assert posture.is_diff and len(posture.joint_state.name) == 16


def test_joints_that_follow_are_left_to_moveit(tmp_path):
    load_shipped_grasp("jug", "barrett").save(tmp_path / "g.safetensors")
    states = mtc_stage.read_states(bags.types(), read(tmp_path / "g.safetensors", tmp_path / "a"))
    names = states[0].grasp.joint_state.name
    assert names == ["spread", "f1_flex", "f2_flex", "f3_flex"]
    renamed = mtc_stage.load_grasps(
        bags.types(),
        tmp_path / "g.safetensors",
        "jug",
        bags.time(7),
        "jug",
        rename={"f1_flex": "right_f1"},
    )
    states = mtc_stage.read_states(bags.types(), renamed)
    assert states[0].grasp.joint_state.name == ["right_f1", "spread", "f2_flex", "f3_flex"]


def test_what_does_not_fit_is_refused_in_a_sentence(file, tmp_path):
    (good,) = read(file, tmp_path / "a")
    states = mtc_stage.read_states(bags.types(), [good])
    stage = mtc_stage.make_stage(CORE, states, "hand")
    scene = Scene({"jug": WORLD_FROM_OBJECT})
    with pytest.raises(ValueError, match="no group 'hand': give the group"):
        generate(stage, scene, Model(group="gripper"))
    with pytest.raises(ValueError, match=r"Joint 'joint_0' is not in group 'hand': give .* rename"):
        generate(stage, scene, Model([f"{name}.0" for name in JOINTS]))
    with pytest.raises(ValueError, match="Frame 'jug' of the grasps is not in the scene: add"):
        generate(stage, Scene({"world": np.eye(4)}))
    with pytest.raises(ValueError, match="No grasps: plan some first"):
        mtc_stage.read_states(bags.types(), [])
    short = copy.deepcopy(good)
    short.grasp_posture.points.pop()
    with pytest.raises(ValueError, match="grasp_0: 2 postures; a pre-grasp, a grasp and a squeeze"):
        mtc_stage.read_states(bags.types(), [short])
    short = copy.deepcopy(good)
    short.grasp_posture.joint_names.pop()
    with pytest.raises(ValueError, match="grasp_0: 15 joints, 16 positions; a position for each"):
        mtc_stage.read_states(bags.types(), [short])
