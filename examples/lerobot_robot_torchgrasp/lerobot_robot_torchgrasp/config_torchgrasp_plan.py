"""The settings of the planned grasp."""

from dataclasses import dataclass

from lerobot.teleoperators import TeleoperatorConfig


@TeleoperatorConfig.register_subclass("torchgrasp_plan")
@dataclass(kw_only=True)
class TorchgraspPlanConfig(TeleoperatorConfig):
    """A planned grasp, which gives the targets of a hand tick by tick.

    Attributes:
        plan: file of grasps, as `torchgrasp grasp` writes it.
        row: number of the grasp in the file; 0 is the best.
        hand: name of a shipped hand, or the folder of your own.
        fps: targets a second; as of the data set.
        force: normal force of the strongest finger [N].
    """

    plan: str
    row: int = 0
    hand: str = "allegro"
    fps: int = 30
    force: float = 4.0
