"""A planned grasp as a skill: the targets of hand and palm, tick by tick."""

import dataclasses
import json
from collections.abc import Iterator

import numpy as np

from torchgrasp import load_grasps
from torchgrasp.export import format_grasps
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.hand.load import hand_of, load_hand
from torchgrasp.values.planning import Grasps

PALM = tuple(f"hand.{x}" for x in ("x", "y", "z", "qx", "qy", "qz", "qw"))
"""Names of the pose of the hand's root in the frame of the grasps [m], as of `write_lerobot`."""


@dataclasses.dataclass(frozen=True)
class MotionNumbers:
    """Parameters of the motion around a grasp."""

    speed: float = 0.2
    """Mean speed of the approach [m/s], as in our trials."""
    height: float = 0.1
    """Height of the lift [m]."""
    lift: float = 1.0
    """Time of the lift [s]."""
    hold: float = 0.5
    """Time for which the object is held [s]."""


MOTION = MotionNumbers()


class GraspSkill:
    """The motion of a planned grasp: approach, closing, squeeze, lift and hold.

    It is a policy that looks at nothing: `select_action` gives the next target, and stays at the
    last one.

    Args:
        plan: file of grasps, as `torchgrasp grasp` writes it.
        row: number of the grasp in the file.
        hand: name of a shipped hand, or the folder of another one.
        fps: targets a second.
        force: normal force of the strongest finger [N].
        motion: times and lengths of the motion.

    Attributes:
        names: joints of the URDF by name [rad], then `PALM`: the names of a target's numbers.
        grasps: the grasp, as a batch of one.
        ends: time [s] at which each phase ends, by its name.

    Raises `BadArgument` for a grasp of another hand or another row, and for one that failed a
    check. Raises it also for a rate that is not positive.
    """

    def __init__(
        self,
        plan: str,
        row: int = 0,
        hand: str = "allegro",
        fps: int = 30,
        force: float = 4.0,
        motion: MotionNumbers = MOTION,
    ) -> None:
        if fps < 1:
            raise BadArgument("fps", fps, "at least one target a second")
        every = load_grasps(plan)
        if not 0 <= row < len(every):
            raise BadArgument("row", row, f"the number of one of {len(every)} grasps in {plan}")
        self.grasps: Grasps = every[row : row + 1]
        status = Status(int(self.grasps.status[0]))
        if status != Status.OK:
            found = f"{row}, which failed: {status.sentence}"
            raise BadArgument("row", found, "a grasp that passed all checks")
        given = load_hand(hand)
        planned = every.meta.get("hand", given.name)
        if planned != given.name:
            raise BadArgument("hand", given.name, f"{planned}, for which the grasps were planned")
        self.hand = hand_of(self.grasps, given)
        self.fps = fps
        self.names = (*self.hand.tree.joint_names, *PALM)
        written = json.loads(format_grasps(self.hand, self.grasps, force))
        self.ends, self._knots = self._plan(written, motion)
        self.reset()

    def _plan(self, written: dict, motion: MotionNumbers) -> tuple[dict[str, float], np.ndarray]:
        """Return the ends of the phases [s], and the targets (phases, names) there."""
        best = written["grasps"][0]
        times = written["time"]
        table = self.grasps.table
        up = np.array([0.0, 0.0, 1.0]) if table is None else table.normal.double().numpy()
        place = np.array(best["pose"]["position"])
        rise = np.array(best["rise"])
        distance = best["approach"]["distance"]
        start = -distance * np.array(best["approach"]["direction"])
        lifted = motion.height * up
        # the end of each phase: displacement of the palm [m], posture, duration [s]
        phases = {
            "start": (rise + start, "pregrasp", 0.0),
            "approach": (rise, "pregrasp", distance / motion.speed),
            "close": (0 * rise, "grasp", times["grasp"] - times["pregrasp"]),
            "squeeze": (0 * rise, "squeeze", times["squeeze"] - times["grasp"]),
            "lift": (lifted, "squeeze", motion.lift),
            "hold": (lifted, "squeeze", motion.hold),
        }
        w, x, y, z = best["pose"]["quaternion_wxyz"]
        knots = []
        for moved, posture, _ in phases.values():
            joints = [best["joints"][posture][name] for name in self.hand.tree.joint_names]
            knots.append([*joints, *(place + moved), x, y, z, w])
        durations = [duration for _, _, duration in phases.values()]
        ends = dict(zip(phases, np.cumsum(durations).tolist(), strict=True))
        return ends, np.array(knots)

    def __len__(self) -> int:
        """Return the number of ticks until the grasp has ended."""
        return int(np.ceil(self.ends["hold"] * self.fps - 1e-9))

    def __iter__(self) -> Iterator[dict[str, float]]:
        """Yield all targets from the first to the last."""
        for tick in range(len(self)):
            yield self.target((tick + 1) / self.fps)

    def target(self, time: float) -> dict[str, float]:
        """Return the target at a time [s] after the start; all move at constant speeds."""
        ends = list(self.ends.values())
        row = [np.interp(time, ends, column) for column in self._knots.T]
        return dict(zip(self.names, map(float, row), strict=True))

    def reset(self) -> None:
        """Begin again."""
        self._tick = 0

    def select_action(self, observation: object = None) -> dict[str, float]:
        """Return the next target; the observation is not looked at."""
        self._tick = min(self._tick + 1, len(self))
        return self.target(self._tick / self.fps)
