"""The hand as a robot of LeRobot."""

import math
from typing import Any

from lerobot.robots import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_robot_torchgrasp.bodies import Body, make_body
from lerobot_robot_torchgrasp.config_torchgrasp_hand import TorchgraspHandConfig
from lerobot_robot_torchgrasp.skill import GraspSkill
from torchgrasp.foundation.errors import BadArgument


class TorchgraspHand(Robot):
    """A hand whose actions are targets of all its joints [rad] and the pose of its root.

    The names are those of the joints in the URDF, then `hand.x` to `hand.qw`. The latter are the
    pose in the frame of the grasps [m], as in the data sets of `write_lerobot`.
    """

    config_class = TorchgraspHandConfig
    name = "torchgrasp_hand"

    def __init__(self, config: TorchgraspHandConfig) -> None:
        super().__init__(config)
        self.config = config
        self.skill = GraspSkill(config.plan, config.row, config.hand, config.fps, config.force)
        self.cameras: dict[str, Any] = {}
        self.body: Body | None = None

    @property
    def action_features(self) -> dict[str, type]:
        """Type of each number of an action by its name."""
        return dict.fromkeys(self.skill.names, float)

    @property
    def observation_features(self) -> dict[str, type]:
        """Type of each number of an observation by its name; the names are those of an action."""
        return dict.fromkeys(self.skill.names, float)

    @property
    def is_connected(self) -> bool:
        """Whether the hand takes actions."""
        return self.body is not None

    def connect(self, calibrate: bool = True) -> None:
        """Make the body, and place the hand at the start of the approach."""
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is connected")
        self.body = make_body(self.config.body, self.skill, self.config.object)
        self.body.place(self.skill.target(0.0))

    @property
    def is_calibrated(self) -> bool:
        """True: the zeros are those of the URDF."""
        return True

    def calibrate(self) -> None:
        """Do nothing: the zeros are those of the URDF."""

    def configure(self) -> None:
        """Do nothing: the drives are those of `hand.toml`."""

    def get_observation(self) -> dict[str, float]:
        """Return joints [rad] and pose of the hand."""
        return self._connected().read()

    def send_action(self, action: dict[str, Any]) -> dict[str, float]:
        """Send a target, and return it.

        Raises `BadArgument` for other names than those of this hand, and for numbers that are not
        finite. Then nothing is sent.
        """
        body = self._connected()
        other = sorted(set(action) ^ set(self.skill.names))
        if other:
            found = f"{len(action)} numbers that differ by {', '.join(other[:3])}"
            allowed = f"those of the {self.skill.hand.name} hand, {len(self.skill.names)} by name"
            raise BadArgument("action", found, allowed)
        target = {name: float(action[name]) for name in self.skill.names}
        wrong = [name for name, x in target.items() if not math.isfinite(x)]
        if wrong:
            raise BadArgument("action", f"{wrong[0]} = {target[wrong[0]]}", "finite numbers")
        body.move(target)
        return target

    def disconnect(self) -> None:
        """Stop the hand."""
        body = self._connected()
        self.body = None
        body.stop()

    def _connected(self) -> Body:
        """Return the body; raise LeRobot's error if the hand is not connected."""
        if self.body is None:
            raise DeviceNotConnectedError(f"{self} is not connected")
        return self.body
