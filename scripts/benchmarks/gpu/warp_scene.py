"""Many simulated scenes of one hand at once, in MuJoCo Warp: on a GPU, or slowly on the CPU."""

import copy
import dataclasses
import importlib
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Any

import numpy as np

from torchgrasp.foundation.errors import BadArgument, MissingExtra
from torchgrasp.sim.mujoco_scene import (
    OBJECT,
    MujocoScene,
    format_numbers,
    import_mujoco,
    scene_mjcf,
)
from torchgrasp.sim.scene_spec import SceneSpec

FIELDS = (
    "body_pos",
    "body_quat",
    "body_ipos",
    "body_iquat",
    "body_mass",
    "body_subtreemass",
    "body_inertia",
    "body_invweight0",
    "dof_invweight0",
    "jnt_axis",
    "jnt_range",
    "actuator_acc0",
    "geom_dataid",
    "geom_size",
    "geom_aabb",
    "geom_rbound",
    "geom_pos",
    "geom_quat",
    "geom_friction",
)
"""Fields of MuJoCo's model that the object, its friction, and the pose of the hand change."""


class WarpScenes:
    """Simulated scenes of one hand, each with its own object and poses, which all advance at once.

    Each scene is the model that `MujocoScene` simulates. All are padded to the same number of
    convex parts: MuJoCo Warp skips a part without a mesh. World c n + k of c copies of n scenes is
    a copy of scene k. `overlap` is the hand's penetration depth (n,) [m] at the start, as from
    MuJoCo. The n `specs` differ in object, friction, and joints and pose of the hand. The `device`
    is Warp's, as "cuda" or "cpu". Raises `BadArgument` for a table or neighbours, or a device that
    Warp does not find, `MissingExtra` without MuJoCo Warp, and the errors of `open_scene`.
    """

    def __init__(self, specs: Sequence[SceneSpec], device: str) -> None:
        self._warp, self._engine = _import_engine()
        try:
            self._warp.get_device(device)
        except ValueError as error:
            raise BadArgument(
                "device", repr(device), "one that Warp finds, as 'cuda' or 'cpu'"
            ) from error
        if any(spec.table or spec.neighbours for spec in specs):
            raise BadArgument(
                "specs", "a scene with a table or neighbours", "scenes of hand and object alone"
            )
        self.device = device
        self.count = len(specs)
        self._graph = None
        models = _Models(specs)
        self.overlap = np.array(models.overlaps)
        self._scene = models.scene
        self.joint_names = models.scene.joint_names
        with self._warp.ScopedDevice(device):
            self._model = self._engine.put_model(models.carrier)
            self._model.opt.warn_overflow = 0
            for name in FIELDS:
                shared = getattr(self._model, name)
                values = np.array([row[name] for row in models.rows]).reshape(
                    self.count, *shared.numpy().shape[1:]
                )
                setattr(self._model, name, self._warp.array(values, dtype=shared.dtype))
            self._fill(np.array(models.positions), np.array(models.controls))

    def _fill(self, positions: np.ndarray, controls: np.ndarray) -> None:
        """Allocate worlds at rest with the given positions (w, q) and targets of the motors (w, u)."""
        self._worlds = len(positions)
        # near pairs of shapes on average, rows of constraints: a contact has at most four
        pairs = 32
        rows = 192
        self._data = self._engine.make_data(
            self._scene.model, self._worlds, nconmax=pairs, njmax=rows
        )
        self._data.qpos.assign(positions)
        self._data.ctrl.assign(controls)

    def copies(self, number: int) -> "WarpScenes":
        """Return a number of copies of all scenes in their present state."""
        scenes = copy.copy(self)
        before = self._data
        with self._warp.ScopedDevice(self.device):
            scenes._graph = None
            scenes._fill(*(np.tile(x.numpy(), (number, 1)) for x in (before.qpos, before.ctrl)))
            for name in ("qvel", "qacc_warmstart"):
                getattr(scenes._data, name).assign(
                    np.tile(getattr(before, name).numpy(), (number, 1))
                )
        return scenes

    def step(self, steps: int) -> None:
        """Advance all worlds by a number of timesteps; a GPU gets all kernels of a timestep as one
        graph.
        """
        with self._warp.ScopedDevice(self.device):
            if self._warp.get_device().is_cuda and self._graph is None:
                self._engine.step(self._model, self._data)  # loads the kernels
                steps -= 1
                with self._warp.ScopedCapture() as capture:
                    self._engine.step(self._model, self._data)
                self._graph = capture.graph
            for _ in range(steps):
                if self._graph is None:
                    self._engine.step(self._model, self._data)
                else:
                    self._warp.capture_launch(self._graph)

    def drive(self, targets: np.ndarray) -> None:
        """Set the targets (n, j) [rad] of the driven joints of each scene."""
        controls = self._data.ctrl.numpy()
        controls[:, self._scene.motors] = np.tile(targets, (self._worlds // self.count, 1))
        self._data.ctrl.assign(controls)

    def pull(self, forces: np.ndarray) -> None:
        """Apply a force (w, 3) [N] at the mass centre of each world's object, in this and all later
        steps.
        """
        wrenches = self._data.xfrc_applied.numpy()
        wrenches[:, self._scene.body, :3] = forces
        self._data.xfrc_applied.assign(wrenches)

    def object_poses(self) -> np.ndarray:
        """Return the poses (w, 4, 4) of the objects in the world's frame.

        They are NaN where the simulation diverged, and where there was no room for all contacts.
        """
        lost = self._engine.OverflowType
        left_out = self._data.overflow.numpy() & (
            lost.NEFC | lost.BROADPHASE | lost.NARROWPHASE | lost.CCD
        )
        start = self._scene.model.joint(OBJECT).qposadr[0]
        found = self._data.qpos.numpy()[:, start : start + 7].astype(float)
        w, x, y, z = (found[:, 3:] / np.linalg.norm(found[:, 3:], axis=-1, keepdims=True)).T
        poses = np.tile(np.eye(4), (len(found), 1, 1))
        poses[:, 0, :3] = np.stack(
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1
        )
        poses[:, 1, :3] = np.stack(
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1
        )
        poses[:, 2, :3] = np.stack(
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1
        )
        poses[:, :3, 3] = found[:, :3]
        poses[left_out != 0] = np.nan
        return poses


class _Models:
    """MuJoCo's models of n scenes; a model is compiled once for each object and friction.

    `rows` holds the `FIELDS` of each scene's model; `overlaps`, `positions` and `controls` are
    those at the start. `carrier` is the model of the first scene with the meshes of all.
    """

    def __init__(self, specs: Sequence[SceneSpec]) -> None:
        most = max(len(spec.parts) for spec in specs)
        made = dict[tuple, MujocoScene]()
        self.overlaps = list[float]()
        self.positions = list[np.ndarray]()
        self.controls = list[np.ndarray]()
        self.rows = list[dict[str, np.ndarray]]()
        meshes = dict[bytes, int]()
        for spec in specs:
            hulls = [vertices.tobytes() for vertices in spec.hulls[0]]
            key = (
                *hulls,
                spec.mass,
                spec.body.inertia.tobytes(),
                spec.body_friction,
                spec.friction,
                spec.patch,
            )
            if key not in made:
                made[key] = MujocoScene(_pad(spec, most))
            self.scene = scene = made[key]
            scene.restart(spec)
            self.overlaps.append(scene.penetration())
            self.positions.append(scene.data.qpos.copy())
            self.controls.append(scene.data.ctrl.copy())
            row = {name: getattr(scene.model, name).copy() for name in FIELDS}
            places = [meshes.setdefault(vertices, len(meshes)) for vertices in hulls]
            row["geom_dataid"][row["geom_dataid"] >= 0] = places + [-1] * (most - len(places))
            self.rows.append(row)
        self.carrier = _compile(
            _pad(specs[0], most), [np.frombuffer(vertices) for vertices in meshes]
        )


def _pad(spec: SceneSpec, most: int) -> SceneSpec:
    """Return a scene whose object has as many parts as the `most`; the first one is repeated."""
    return dataclasses.replace(
        spec, parts=[*spec.parts, *[spec.parts[0]] * (most - len(spec.parts))]
    )


def _compile(spec: SceneSpec, meshes: list[np.ndarray]) -> Any:
    """Return MuJoCo's model of a scene with the given meshes (flat vertices), in their order."""
    mujoco = import_mujoco()
    root = ET.fromstring(scene_mjcf(spec))
    asset = root.find("asset")
    assert asset is not None
    for k, vertices in enumerate(meshes):
        ET.SubElement(asset, "mesh", name=f"mesh_{k}", vertex=format_numbers(vertices))
    for mesh in asset.findall("mesh")[: len(spec.parts)]:
        asset.remove(mesh)
    for geom in root.iter("geom"):
        if geom.get("mesh"):
            geom.set("mesh", "mesh_0")  # every world replaces it
    model = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    model.opt.disableflags &= ~int(
        mujoco.mjtDisableBit.mjDSBL_AUTORESET
    )  # MuJoCo Warp never resets a world
    return model


def _import_engine() -> tuple[Any, Any]:
    """Import and return Warp and MuJoCo Warp."""
    try:
        warp, engine = (importlib.import_module(name) for name in ("warp", "mujoco_warp"))
    except ImportError as error:
        raise MissingExtra("mujoco_warp", "warp") from error
    warp.config.quiet = True
    return warp, engine
