"""A planned grasp as a teleoperator of LeRobot: it takes the place of a person's hand."""

from typing import Any

from lerobot.teleoperators import Teleoperator
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_robot_torchgrasp.config_torchgrasp_plan import TorchgraspPlanConfig
from lerobot_robot_torchgrasp.skill import GraspSkill


class TorchgraspPlan(Teleoperator):
    """The motion of a planned grasp, one target for each call; after its end it holds the last one.

    It begins when it is connected.
    """

    config_class = TorchgraspPlanConfig
    name = "torchgrasp_plan"

    def __init__(self, config: TorchgraspPlanConfig) -> None:
        super().__init__(config)
        self.config = config
        self.skill = GraspSkill(config.plan, config.row, config.hand, config.fps, config.force)
        self._connected = False

    @property
    def action_features(self) -> dict[str, type]:
        """Type of each number of an action by its name."""
        return dict.fromkeys(self.skill.names, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        """No feedback is taken."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether targets are given."""
        return self._connected

    def connect(self, calibrate: bool = True) -> None:
        """Begin the motion."""
        if self._connected:
            raise DeviceAlreadyConnectedError(f"{self} is connected")
        self.skill.reset()
        self._connected = True

    @property
    def is_calibrated(self) -> bool:
        """True: there is nothing to calibrate."""
        return True

    def calibrate(self) -> None:
        """Do nothing."""

    def configure(self) -> None:
        """Do nothing."""

    def get_action(self) -> dict[str, float]:
        """Return the target of the next tick."""
        if not self._connected:
            raise DeviceNotConnectedError(f"{self} is not connected")
        return self.skill.select_action()

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing."""

    def disconnect(self) -> None:
        """Give no more targets."""
        self._connected = False
