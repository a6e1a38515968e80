"""The settings of the hand."""

from dataclasses import dataclass

from lerobot.robots import RobotConfig


@RobotConfig.register_subclass("torchgrasp_hand")
@dataclass(kw_only=True)
class TorchgraspHandConfig(RobotConfig):
    """A hand that moves to joint targets, in simulation or as a class of your own.

    Attributes:
        plan: file of grasps, as `torchgrasp grasp` writes it; the hand starts at its approach.
        row: number of the grasp in the file; 0 is the best.
        hand: name of a shipped hand, or the folder of your own.
        body: "dry" is at its targets at once. "mujoco" simulates hand, object and table. Or it is a
            class of your own as "module:Class", which has the methods of `bodies.Body`.
        object: shipped object, or file of its closed mesh [m] in the frame of the grasps; "mujoco"
            needs it.
        fps: targets a second; as of the data set.
        force: normal force of the strongest finger [N].
    """

    plan: str
    row: int = 0
    hand: str = "allegro"
    body: str = "dry"
    object: str = ""
    fps: int = 30
    force: float = 4.0
