"""What moves the hand: nothing, MuJoCo, or the driver of your own hand."""

import importlib
import json
import tempfile
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from lerobot_robot_torchgrasp.skill import PALM, GraspSkill
from torchgrasp import list_objects, load_object
from torchgrasp.export import save_play
from torchgrasp.foundation.errors import BadArgument, MissingExtra


class Body(Protocol):
    """A hand that a class of your own moves; it is made with the `GraspSkill`.

    Targets and readings are numbers by the skill's `names`: joints [rad], and the palm's pose.
    """

    def place(self, start: dict[str, float]) -> None:
        """Go to the start of the approach, however long it takes."""
        ...

    def move(self, target: dict[str, float]) -> None:
        """Send the target of the next tick; a simulator advances by the tick."""
        ...

    def read(self) -> dict[str, float]:
        """Return where joints and palm are."""
        ...

    def stop(self) -> None:
        """Stop: no motion follows."""
        ...


class DryBody:
    """A hand that is at its targets at once."""

    def __init__(self, skill: GraspSkill) -> None:
        self.place(skill.target(0.0))

    def place(self, start: dict[str, float]) -> None:
        """Be at the start."""
        self._at = dict(start)

    def move(self, target: dict[str, float]) -> None:
        """Be at the target."""
        self._at = dict(target)

    def read(self) -> dict[str, float]:
        """Return the last target."""
        return dict(self._at)

    def stop(self) -> None:
        """Stay."""


class MujocoBody:
    """Hand, object and table in MuJoCo, with the drives of `hand.toml`.

    The mount moves along straight lines; it does not turn. `object` is a shipped object, or the
    file of a closed mesh [m]. Raises `BadArgument` without an object, and `MissingExtra` without
    MuJoCo.
    """

    def __init__(self, skill: GraspSkill, object: str) -> None:
        if not object:
            raise BadArgument("object", "none", "a shipped object or a mesh, for MuJoCo")
        try:
            import mujoco
        except ImportError as error:
            raise MissingExtra("mujoco", "mujoco") from error
        self._engine: Any = mujoco
        known = load_object(object) if object in list_objects() else None
        mesh = Path(object) if known is None else known.mesh
        parts = None if known is None else known.parts
        with tempfile.TemporaryDirectory() as folder:
            save_play(skill.hand, skill.grasps, folder, "mujoco", mesh, parts=parts)
            self.model = mujoco.MjModel.from_xml_path(str(Path(folder, "scene.xml")))
            played = json.loads(Path(folder, "play.json").read_text("utf-8"))["grasps"][0]
        base = self.model.body("torchgrasp_base")
        base.pos = played["position"]
        base.quat = played["quaternion"]
        self.data = mujoco.MjData(self.model)
        self._skill = skill
        self._joints = skill.hand.tree.joint_names
        mount = [f"torchgrasp_mount_{axis}" for axis in "xyz"]
        names = (*self._joints, *mount)
        self._motors = [self.model.actuator(name).id for name in names]
        self._places = [self.model.joint(name).qposadr[0] for name in names]
        pose = skill.grasps.obj_from_hand[0].double().numpy()
        self._rotation = pose[:3, :3]
        self._origin = pose[:3, 3]
        self._steps = max(1, round(1 / skill.fps / self.model.opt.timestep))
        self.place(skill.target(0.0))

    def place(self, start: dict[str, float]) -> None:
        """Put the object on the table, and the hand at the start."""
        mujoco = self._engine
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self._places] = self.data.ctrl[self._motors] = self._drives(start)
        mujoco.mj_forward(self.model, self.data)
        self._rest = float(self.data.body("torchgrasp_object").xipos[2])

    def move(self, target: dict[str, float]) -> None:
        """Advance by a tick, in which the drives' targets move evenly to the new one."""
        before = self.data.ctrl[self._motors].copy()
        after = self._drives(target)
        for step in range(self._steps):
            share = (step + 1) / self._steps
            self.data.ctrl[self._motors] = before + share * (after - before)
            self._engine.mj_step(self.model, self.data)

    def read(self) -> dict[str, float]:
        """Return the joints and the pose of the palm; the mount does not turn."""
        found = self.data.qpos[self._places]
        joints = dict(zip(self._joints, found[:-3].tolist(), strict=True))
        place = self._origin + self._rotation @ found[-3:]
        turned = [self._skill.target(0.0)[name] for name in PALM[3:]]
        return joints | dict(zip(PALM, [*place.tolist(), *turned], strict=True))

    def stop(self) -> None:
        """Hold the last targets."""

    @property
    def risen(self) -> float:
        """How far the object has risen [m]."""
        return float(self.data.body("torchgrasp_object").xipos[2]) - self._rest

    def _drives(self, target: dict[str, float]) -> np.ndarray:
        """Return the drives' targets: joints [rad], then the mount along the hand's axes [m]."""
        place = np.array([target[name] for name in PALM[:3]])
        mount = self._rotation.T @ (place - self._origin)
        return np.array([*(target[name] for name in self._joints), *mount])


def make_body(name: str, skill: GraspSkill, object: str) -> Body:
    """Return the body with a name: "dry", "mujoco", or "module:Class" of your own.

    Raises `BadArgument` for another name, or a class that cannot be imported.
    """
    if name == "dry":
        return DryBody(skill)
    if name == "mujoco":
        return MujocoBody(skill, object)
    module, _, kind = name.partition(":")
    try:
        return getattr(importlib.import_module(module), kind)(skill)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        allowed = '"dry", "mujoco", or "module:Class" of a class that takes the skill'
        raise BadArgument("body", f"{name!r} ({error})", allowed) from error
