"""Ranked grasps with finger postures as stages of MoveIt Task Constructor (MTC).

Input are moveit_msgs/Grasp: of the action `plan_grasp`, or of a file (`load_grasps`). `pick` returns
a container with one sequence of stages for each grasp: pose, pre-grasp, grasp, squeeze, attached.
`make_stage` returns the generator alone. MTC's modules `core` and `stages` are arguments, so this
file needs no ROS when it is imported.
"""

import copy
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import messages

from torchgrasp import Status
from torchgrasp import load_grasps as read_file
from torchgrasp.export import format_moveit
from torchgrasp.hand import hand_of
from torchgrasp.ik import opened_pose

if TYPE_CHECKING:
    from rosbags.typesys.stores import ros2_humble as ros


POSTURES = "pregrasp", "grasp", "squeeze"


class GraspStates(NamedTuple):
    """One grasp as MTC takes it.

    `target` is the pose of the hand's frame. The postures are moveit_msgs/RobotState, differences
    that move the hand's joints alone. `approach` is a moveit_msgs/GripperTranslation. `cost` is 1
    minus the predicted success.
    """

    name: str
    target: "ros.geometry_msgs__msg__PoseStamped"
    approach: Any
    pregrasp: Any
    grasp: Any
    squeeze: Any
    cost: float


class Robot(NamedTuple):
    """Names of the robot in its SRDF."""

    arm: str  # group of the arm's joints
    hand: str  # group of the hand's joints, which is the end effector's group
    eef: str  # end effector
    frame: str  # link to which the grasps' poses refer: the hand's root link, or the flange
    links: tuple[str, ...]  # links of the hand, which may touch the object


def load_grasps(
    types: messages.Types,
    path: Path | str,
    frame: str,
    stamp: Any,
    object_id: str,
    most: int = 20,
    **options: Any,
) -> list[Any]:
    """Return the best moveit_msgs/Grasp of a file of `torchgrasp grasp`, with poses in `frame`.

    `options` are those of `torchgrasp.export.format_moveit`: the robot's names of joints as
    `rename`, `force`, `kp`, and `flange`.

    Joints that follow others are left out, since MoveIt sets them itself. So are grasps whose hand
    goes down while it closes: a message has one pose.
    """
    grasps = read_file(path)
    hand = hand_of(grasps)
    opened = opened_pose(hand, grasps.pregrasp, grasps.obj_from_hand, grasps.table)
    stays = (opened == grasps.obj_from_hand).all(2).all(1)
    best = grasps[(grasps.status == Status.OK) & stays][:most]
    text = format_moveit(hand, best, object_id=object_id, actuated=True, **options)
    return messages.write_grasps(types, text, frame, stamp)


def read_states(types: messages.Types, grasps: Iterable[Any]) -> tuple[GraspStates, ...]:
    """Return moveit_msgs/Grasp as states, best first; each must have a pre-grasp, a grasp and a
    squeeze.
    """
    states = list[GraspStates]()
    for grasp in grasps:
        trajectories = (grasp.pre_grasp_posture, grasp.grasp_posture)
        points = [(x.joint_names, point) for x in trajectories for point in x.points]
        if len(points) != len(POSTURES):
            words = "a pre-grasp, a grasp and a squeeze are needed"
            raise ValueError(f"{grasp.id}: {len(points)} postures; {words}.")
        postures = list[Any]()
        for names, point in points:
            if len(names) != len(point.positions):
                words = f"{len(names)} joints, {len(point.positions)} positions"
                raise ValueError(f"{grasp.id}: {words}; a position for each joint is needed.")
            postures.append(_state(types, names, point.positions, grasp.grasp_pose.header))
        named = dict(zip(POSTURES, postures, strict=True))
        cost = 1.0 - grasp.grasp_quality
        pose = grasp.grasp_pose
        states.append(GraspStates(grasp.id, pose, grasp.pre_grasp_approach, **named, cost=cost))
    if not states:
        raise ValueError("No grasps: plan some first.")
    return tuple(sorted(states, key=lambda state: state.cost))


def _state(types: messages.Types, names: Sequence[str], positions: Any, header: Any) -> Any:
    """Return a moveit_msgs/RobotState that moves joints to `positions` [rad]."""
    # MTC takes differences alone, and no joints of other groups
    joints = types.JointState(
        header=header,
        name=list(names),
        position=types.floats(positions),
        velocity=types.floats(()),
        effort=types.floats(()),
    )
    several = types.MultiDOFJointState(
        header=header, joint_names=[], transforms=[], twist=[], wrench=[]
    )
    return types.RobotState(
        joint_state=joints,
        multi_dof_joint_state=several,
        attached_collision_objects=[],
        is_diff=True,
    )


def make_stage(core: Any, states: Sequence[GraspStates], group: str, name: str = "grasps") -> Any:
    """Return an MTC generator that offers each grasp as an interface state.

    The hand is at the pre-grasp there. The state has `target_pose`, which ComputeIK reads. It has
    `pregrasp`, `grasp` and `squeeze`, where MTC's Python takes a RobotState as a property. Costs
    are those of the states. Set the monitored stage, which gives the scene: `setMonitoredStage`.
    `group` is that of the hand's joints.
    """

    class GenerateGrasps(core.MonitoringGenerator):
        """Offers grasps in each scene of the monitored stage, the best first."""

        def __init__(self) -> None:
            core.MonitoringGenerator.__init__(self, name)
            self.pending: list[tuple[Any, GraspStates]] = []

        def init(self, robot_model: Any) -> None:
            """Refuse joints that the hand's group does not have."""
            core.MonitoringGenerator.init(self, robot_model)
            _check_joints(robot_model, states, group)

        def reset(self) -> None:
            """Forget all scenes."""
            core.MonitoringGenerator.reset(self)
            self.pending = []

        def onNewSolution(self, solution: Any) -> None:
            """Take the scene of the monitored stage, in which the object is."""
            scene = solution.end.scene
            frame = states[0].target.header.frame_id
            if not scene.knows_frame_transform(frame):
                words = f"Frame {frame!r} of the grasps is not in the scene"
                raise ValueError(f"{words}: add the object, or its frame.")
            self.pending += [(scene, state) for state in states]

        def canCompute(self) -> bool:
            """Return whether grasps are left."""
            return bool(self.pending)

        def compute(self) -> None:
            """Offer the best grasp that is left."""
            scene, grasp = self.pending.pop(0)
            state = core.InterfaceState(_opened(scene, grasp))
            state.properties["target_pose"] = grasp.target
            for key in POSTURES:
                try:
                    state.properties[key] = getattr(grasp, key)
                except TypeError:
                    # no RobotState as a property here: `pick` gives it to the stages that move
                    break
            self.spawn(state, grasp.cost)

    return GenerateGrasps()


def _check_joints(robot_model: Any, states: Sequence[GraspStates], group: str) -> None:
    """Raise `ValueError` for a group or joints that the robot does not have."""
    if not robot_model.has_joint_model_group(group):
        raise ValueError(f"The robot has no group {group!r}: give the group of the hand's joints.")
    known = robot_model.get_joint_model_group(group).joint_model_names
    for state in states:
        if unknown := [x for x in state.grasp.joint_state.name if x not in known]:
            words = f"Joint {unknown[0]!r} is not in group {group!r}"
            raise ValueError(f"{words}: give the robot's names of joints as rename.")


def _opened(scene: Any, grasp: GraspStates) -> Any:
    """Return a copy of the scene in which the hand is at the pre-grasp."""
    opened = copy.copy(scene)
    # older bindings return a copy of the state, so it is set as a whole
    robot = opened.current_state
    joints = grasp.pregrasp.joint_state
    robot.joint_positions = dict(zip(joints.name, map(float, joints.position), strict=True))
    robot.update()
    opened.current_state = robot
    return opened


def pick(
    types: messages.Types,
    core: Any,
    stages: Any,
    monitored: Any,
    states: Sequence[GraspStates],
    robot: Robot,
    object_id: str,
    press: bool = True,
) -> Any:
    """Return a container of alternatives, one for each grasp, for a task after a Connect stage.

    Each has the approach, and the arm's inverse kinematics with the hand at the pre-grasp. Then the
    hand may touch the object, closes to the grasp, presses to the squeeze if `press`, and holds it.

    Args:
        types: the classes of messages.
        core: MTC's Python module `moveit.task_constructor.core`.
        stages: MTC's Python module `moveit.task_constructor.stages`.
        monitored: the stage whose scene has the object, such as `task["current"]`.
        states: the grasps.
        robot: names of the robot.
        object_id: the object's id in the planning scene.
        press: move on to the squeeze; without it, a controller of forces must press.
    """
    container = core.Alternatives("grasps")
    straight = core.CartesianPath()
    motion = core.JointInterpolationPlanner()
    for state in states:
        header = types.Header(stamp=state.target.header.stamp, frame_id=robot.frame)
        here = types.Pose(
            position=types.Point(x=0.0, y=0.0, z=0.0),
            orientation=types.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
        )
        ik_frame = types.PoseStamped(header=header, pose=here)
        approach = stages.MoveRelative(f"{state.name}: approach", straight)
        approach.group = robot.arm
        approach.ik_frame = ik_frame
        approach.min_distance = state.approach.min_distance
        approach.max_distance = state.approach.desired_distance
        approach.setDirection(state.approach.direction)
        # a stage that is given to another is its own from then on
        generator = make_stage(core, [state], robot.hand, f"{state.name}: pose")
        generator.setMonitoredStage(monitored)
        reach = stages.ComputeIK(f"{state.name}: reach", generator)
        reach.eef = robot.eef
        reach.ik_frame = ik_frame
        source = core.Stage.PropertyInitializerSource.INTERFACE
        reach.properties.configureInitFrom(source, ["target_pose"])
        touch = stages.ModifyPlanningScene(f"{state.name}: touch")
        touch.allowCollisions(object_id, list(robot.links), True)
        goals = {"close": state.grasp, "press": state.squeeze}
        if not press:
            del goals["press"]
        moves = [stages.MoveTo(f"{state.name}: {word}", motion) for word in goals]
        for move, goal in zip(moves, goals.values(), strict=True):
            move.group = robot.hand
            move.setGoal(goal)
        hold = stages.ModifyPlanningScene(f"{state.name}: hold")
        hold.attachObject(object_id, robot.frame)
        sequence = core.SerialContainer(state.name)
        for stage in (approach, reach, touch, *moves, hold):
            sequence.add(stage)
        container.add(sequence)
    return container
