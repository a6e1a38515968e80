"""A record of what a controlled hand observed and commanded, tick by tick, to be read back elsewhere."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Batch, join, named_tensors
from torchgrasp.checks import Positive, checked
from torchgrasp.control.observation import Observation
from torchgrasp.control.tactile import no_contact
from torchgrasp.control.targets import Targets
from torchgrasp.errors import BadArgument
from torchgrasp.files import save_tensors
from torchgrasp.value_files import read_value


@checked
@dataclasses.dataclass(frozen=True)
class ControlLog(Batch):
    """What went into a controller and came out of it; a row a tick. `ControlRecorder` makes it.

    `joints`, `tips`, `jacobian`, `reading`, `forces`, `contact`, `points`, `normals`, `average` and `sliding` are as in
    `Observation` and its fingertips. Points and normals are 0 where none were `sensed`. `targets` [rad], `palm` and
    `left` [m] were commanded, `period` [s] is the time until the next tick.
    """

    period: Float[Tensor, " t"]
    joints: Float[Tensor, "t j"]
    tips: Float[Tensor, "t f 3"]
    jacobian: Float[Tensor, "t f 3 j"]
    reading: Float[Tensor, "t f"]
    forces: Float[Tensor, "t f 3"]
    contact: Bool[Tensor, "t f"]
    sensed: Bool[Tensor, "t f"]
    points: Float[Tensor, "t f 3"]
    normals: Float[Tensor, "t f 3"]
    average: Float[Tensor, "t f"]
    sliding: Float[Tensor, "t f"]
    targets: Float[Tensor, "t j"]
    palm: Float[Tensor, "t 3"]
    left: Float[Tensor, " t"]

    def ticks(self) -> Iterator[tuple[Observation, float, Targets]]:
        """Yield observation, period and targets of each tick."""
        for k in range(len(self)):
            sensed = self.sensed[k, :, None]
            tactile = dataclasses.replace(
                no_contact(fingers=len(sensed)),
                reading=self.reading[k],
                forces=self.forces[k],
                contact=self.contact[k],
                points=torch.where(sensed, self.points[k], torch.nan),
                normals=torch.where(sensed, self.normals[k], torch.nan),
                average=self.average[k],
                sliding=self.sliding[k],
            )
            seen = Observation(self.joints[k], self.tips[k], self.jacobian[k], tactile)
            yield seen, float(self.period[k]), Targets(self.targets[k], self.palm[k], float(self.left[k]))

    @checked
    def save(self, path: Path | str) -> None:
        """Write the log as a safetensors file, whole or not at all; `load_control_log` reads it.

        Raises:
            OutputError: the file cannot be written.
        """
        save_tensors(path, "control log", named_tensors(self), {})


@checked
def load_control_log(path: Path | str) -> ControlLog:
    """Read a log that `ControlLog.save` wrote.

    Raises:
        ModelFileError: the file is missing or malformed.

    >>> import tempfile
    >>> from torchgrasp import load_hand
    >>> from torchgrasp.control import observe
    >>> hand, recorder = load_hand("barrett"), ControlRecorder()
    >>> recorder.add(observe(hand, hand.lower, no_contact()), 0.01, Targets(torch.zeros(8).double()))
    >>> file = Path(tempfile.mkdtemp(), "log.safetensors")
    >>> recorder.log().save(file)
    >>> log = load_control_log(file)
    >>> log.joints.shape, [period for seen, period, targets in log.ticks()]
    (torch.Size([1, 8]), [0.01])
    """
    return read_value(path, "control log", ControlLog)[0]


class ControlRecorder:
    """Collects the ticks of a controlled hand.

    >>> from torchgrasp import load_hand, load_object, plan_grasps
    >>> from torchgrasp.control import ClosingReference, GraspController, observe
    >>> hand = load_hand("allegro")
    >>> reference = ClosingReference.from_grasp(hand, plan_grasps(load_object("cylinder").view, hand, starts=20)[0])
    >>> controller, recorder = GraspController(reference), ControlRecorder()
    >>> for _ in range(5):
    ...     seen = observe(hand, reference.pregrasp, no_contact())
    ...     recorder.add(seen, 0.01, controller.step(seen, 0.01))
    >>> len(recorder.log())
    5
    """

    def __init__(self) -> None:
        self._rows: list[ControlLog] = []

    @checked
    def add(self, observation: Observation, period: Positive, targets: Targets) -> None:
        """Add what was observed, the period [s], and the targets that it led to."""
        seen = observation.tactile
        sensed = torch.isfinite(seen.points + seen.normals).all(-1)
        row = {
            "period": torch.tensor(period, dtype=torch.float64),
            "joints": observation.joints,
            "tips": observation.tips,
            "jacobian": observation.jacobian,
            "reading": seen.reading,
            "forces": seen.forces,
            "contact": seen.contact,
            "sensed": sensed,
            "points": torch.where(sensed[:, None], seen.points, 0.0),
            "normals": torch.where(sensed[:, None], seen.normals, 0.0),
            "average": seen.average,
            "sliding": seen.sliding,
            "targets": targets.joints,
            "palm": targets.palm,
            "left": torch.tensor(targets.left, dtype=torch.float64),
        }
        self._rows.append(ControlLog(**{name: x[None].clone() for name, x in row.items()}))

    @checked
    def log(self) -> ControlLog:
        """Return all that was added.

        Raises:
            BadArgument: nothing was.
        """
        if not self._rows:
            raise BadArgument("log", "no ticks", "at least one: `add` them")
        return join(self._rows)
