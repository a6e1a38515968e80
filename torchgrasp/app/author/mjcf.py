"""MJCF files as URDFs: MuJoCo's own compiler reads the file, and the model is written as a URDF.

So default classes, units of angles, frames and missing inertias mean what they mean in MuJoCo. All
checks and repairs are then those of a URDF.
"""

import dataclasses
import functools
import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchgrasp.app.author.mjcf_text import read_mjcf_text
from torchgrasp.app.author.repair import place
from torchgrasp.app.author.tendons import Contradiction, Joints, Mechanism, couple_joints
from torchgrasp.files import write_file
from torchgrasp.foundation.base import FINGERTIPS
from torchgrasp.foundation.errors import BadArgument, HandFileError
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.foundation.limits import HAND_LINKS
from torchgrasp.hand.urdf import Urdf, read_published
from torchgrasp.sim.mujoco_scene import import_mujoco

FINENESS = 3  # subdivisions of an icosahedron that stands for an ellipsoid
STRAIGHT = 2  # coefficients of a polynomial of degree one
CURVED = slice(2, 5)  # further coefficients of an equality of joints in MuJoCo
FIT_POINTS = 101  # positions at which a straight line is fitted to a polynomial
WORLD = "world"
TIP = "tip"  # in the name of a site at a fingertip


class FromMjcf(NamedTuple):
    """An MJCF as a URDF.

    `tips` are the links with a site at a fingertip, () if these are not three to five. `told` and
    `warnings` hold a sentence each for what the URDF says otherwise, or cannot say.
    """

    urdf: Urdf
    tips: tuple[str, ...]
    told: tuple[str, ...]
    warnings: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Drive:
    """Limits [rad or m] and effort [N m or N] of a joint; the effort is 0 if the file has none."""

    lower: float
    upper: float
    effort: float


def read_mjcf(
    path: Path,
    folder: Path,
    root: str = "",
    tips: Sequence[str] = (),
    visual: bool = False,
    meshes: Path | None = None,
) -> FromMjcf:
    """Return an MJCF as a URDF, whose meshes are written to `folder`.

    All files of the MJCF lie below the folder `meshes`, by default its own. `root` names a body of
    the hand, if the file has more. `tips` are sites or bodies that the user chose. With `visual`,
    bodies without collision geoms take their visual ones. Raises `HandFileError` for a file that is
    refused, and `MissingExtra` without MuJoCo.
    """
    mujoco = import_mujoco()
    safe = read_mjcf_text(path, meshes)
    refuse = functools.partial(HandFileError, "mjcf")
    try:
        model = mujoco.MjModel.from_xml_string(safe.text, safe.meshes)
    except ValueError as error:
        said = " ".join(str(error).split())
        raise refuse(f"{path}: {said}", "a file that MuJoCo compiles") from error
    if model.nbody > HAND_LINKS:
        raise refuse(f"{path} of {model.nbody} bodies", f"at most {HAND_LINKS} bodies")
    reader = _Reader(mujoco, model, path)
    reader.choose(root)
    mechanism = reader.couple()
    text = reader.write(folder, mechanism, safe.name, tips, visual)
    write_file(folder / "hand.urdf", text)
    try:
        urdf = read_published(folder / "hand.urdf", visual)
    except HandFileError as error:
        found = str(error.found).replace(str(folder / "hand.urdf"), str(path))
        raise refuse(found, error.allowed) from error
    # a URDF cannot say that a joint follows a sum
    joints = tuple(
        dataclasses.replace(j, mimic=mechanism.followers.get(j.name)) for j in urdf.joints
    )
    urdf = dataclasses.replace(urdf, path=path, joints=joints)
    if safe.left_out:
        reader.told.append(f"not read: {', '.join(safe.left_out)}")
    begin = f"the MJCF is written as a URDF of {len(urdf.links)} links"
    told = (begin, *reader.told, *mechanism.told)
    return FromMjcf(urdf, reader.tip_links(), told, tuple(reader.warnings))


class _Reader:
    """The part of a compiled model that is a hand, and its joints.

    Attributes:
        bodies: indices of the bodies of the hand, parents first; a world body that is kept is 0.
        joints: indices of their joints of one coordinate, in the order of the bodies.
        told, warnings: sentences for the user.
    """

    def __init__(self, mujoco: Any, model: Any, path: Path) -> None:
        self.mujoco = mujoco
        self.model = model
        self.path = path
        self.bodies: list[int] = []
        self.joints: list[int] = []
        self.told: list[str] = []
        self.warnings: list[str] = []
        self.parents = model.body_parentid.tolist()
        self.names = _names(model, "body", model.nbody)
        self.joint_names = _names(model, "joint", model.njnt)
        kinds = mujoco.mjtJoint
        scalar = {int(kinds.mjJNT_HINGE), int(kinds.mjJNT_SLIDE)}
        self.scalar = [int(kind) in scalar for kind in model.jnt_type]
        self.free = [int(kind) == int(kinds.mjJNT_FREE) for kind in model.jnt_type]
        self.slides = [int(kind) == int(kinds.mjJNT_SLIDE) for kind in model.jnt_type]

    def refuse(self, found: str, allowed: str) -> HandFileError:
        """Return the error to raise if the file has `found` in place of `allowed`."""
        return HandFileError("mjcf", f"{self.path}: {found}", allowed)

    def choose(self, root: str) -> None:
        """Choose the bodies of the hand: all below its first body, or those below several bodies
        of the world that move.
        """
        model = self.model
        top = list(range(model.nbody))
        for k in range(1, model.nbody):
            top[k] = k if self.parents[k] == 0 else top[self.parents[k]]
        owner = model.jnt_bodyid.tolist()
        moved = self._moved()
        if not moved.any():
            allowed = 'an actuator for every motor, as <position joint="..."/> in <actuator>'
            raise self.refuse("no actuator that moves a joint or a fixed tendon", allowed)
        driven = list(dict.fromkeys(top[owner[k]] for k in np.flatnonzero(moved).tolist()))
        if root:
            if root not in self.names:
                bodies = f"a body of {self.path}: {sorted(self.names)}"
                raise BadArgument("root", repr(root), bodies)
            driven = [top[self.names.index(root)]]
        hands = [k for k in driven if self._ends(k, top) >= FINGERTIPS[0]]
        if len(hands) > 1:
            names = " and ".join(self.names[k] for k in hands)
            raise self.refuse(f"several hands, {names}", "one hand: --root BODY chooses one")
        if hands:
            driven = hands
        single = len(driven) == 1
        if not single:
            # fingers on the world itself: its other bodies that stand still are the palm
            moving = {top[k] for k in owner}
            driven += [k for k in range(1, model.nbody) if top[k] == k and k not in moving]
        self.bodies = [k for k in range(1, model.nbody) if top[k] in driven]
        self.on_world = not single
        self.root = driven[0] if single and not self._own(driven[0]) else 0
        if not self.root:
            self.bodies.insert(0, 0)
        left = [self.names[k] for k in range(1, model.nbody) if top[k] == k and k not in driven]
        if left:
            self.told.append(f"bodies beside the hand are left out: {', '.join(left)}")
        for k in self.bodies:
            for j in range(model.njnt):
                if owner[j] != k:
                    continue
                if self.free[j]:
                    self.told.append(
                        f"the free joint of {self.names[k]} is dropped: the hand starts there"
                    )
                elif self.scalar[j]:
                    self.joints.append(j)
                else:
                    found = f"joint {self.joint_names[j]} is a ball joint"
                    raise self.refuse(found, "hinges and slides: three hinges for a ball joint")

    def _own(self, body: int) -> list[int]:
        """Return the joints of one coordinate between a body and its parent."""
        owner = self.model.jnt_bodyid.tolist()
        return [j for j in range(self.model.njnt) if owner[j] == body and self.scalar[j]]

    def _ends(self, first: int, top: Sequence[int]) -> int:
        """Return the number of branches below a body of the world that joints move."""
        inside = [k for k in range(1, self.model.nbody) if top[k] == first]
        count = 0
        for k in inside:
            if k in self.parents:
                continue
            while k and not self._own(k):
                k = self.parents[k]
            count += k > 0
        return count

    def _moved(self) -> np.ndarray:
        """Return a mask of all joints of the file that an actuator moves by itself or by a tendon."""
        model = self.model
        moved = np.zeros(model.njnt, dtype=bool)
        for k in range(model.nu):
            moved |= self._pull(k) != 0
        return moved & np.array(self.scalar, dtype=bool)

    def _pull(self, actuator: int) -> np.ndarray:
        """Return the moment arms of an actuator on all joints; zero if it moves no joint."""
        model = self.model
        kinds = self.mujoco.mjtTrn
        kind = int(model.actuator_trntype[actuator])
        target = int(np.ravel(model.actuator_trnid[actuator])[0])
        row = np.zeros(model.njnt)
        gear = float(np.ravel(model.actuator_gear[actuator])[0])
        if kind in (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT)):
            row[target] = gear
        elif kind == int(kinds.mjTRN_TENDON):
            row = gear * self._tendon(target)
        return row

    def _is_fixed(self, tendon: int) -> bool:
        first = int(self.model.tendon_adr[tendon])
        kind = int(self.model.wrap_type[first])
        return kind == int(self.mujoco.mjtWrap.mjWRAP_JOINT)

    def _tendon(self, tendon: int) -> np.ndarray:
        """Return the coefficients of a fixed tendon for all joints, zero for a spatial one."""
        model = self.model
        row = np.zeros(model.njnt)
        if self._is_fixed(tendon):
            first = int(model.tendon_adr[tendon])
            for k in range(first, first + int(model.tendon_num[tendon])):
                row[int(model.wrap_objid[k])] += float(model.wrap_prm[k])
        return row

    def couple(self) -> Mechanism:
        """Return which joints of the hand lead, follow or stand still.

        Each joint's limits and its greatest force or torque are stored in `drives`. Raises
        `HandFileError` for actuators, tendons or equalities of another kind. It is also raised for
        equalities that contradict each other.
        """
        model = self.model
        own = self.joints
        names = tuple(self.joint_names[j] for j in own)
        pulls = np.array([self._pull(k) for k in range(model.nu)])[:, own]
        self._check_actuators(pulls)
        self._check_tendons()
        equal, values = self._equalities()
        at = model.jnt_qposadr[own]
        mechanics = Joints(
            names,
            np.ravel(model.jnt_stiffness[own]).astype(float),
            np.ravel(model.dof_damping[model.jnt_dofadr[own]]).astype(float),
            np.ravel(model.qpos_spring[at]).astype(float),
            np.ravel(model.qpos0[at]).astype(float),
        )
        try:
            mechanism = couple_joints(mechanics, equal[:, own], values, pulls[pulls.any(1)])
        except Contradiction as error:
            found = f"equalities of the joints {error} that no posture obeys"
            raise self.refuse(found, "equalities that agree with each other") from error
        self.drives = self._drives(pulls, mechanism)
        return mechanism

    def _check_actuators(self, pulls: np.ndarray) -> None:
        """Raise `HandFileError` for an actuator of the hand that moves it in another way."""
        model = self.model
        kinds = self.mujoco.mjtTrn
        base = self.root or -1
        plain = {int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT), int(kinds.mjTRN_TENDON)}
        names = _names(model, "actuator", model.nu)
        for k in range(model.nu):
            kind = int(model.actuator_trntype[k])
            if kind in plain or kind == int(kinds.mjTRN_BODY):
                continue
            target = int(np.ravel(model.actuator_trnid[k])[0])
            if kind == int(kinds.mjTRN_SITE):
                body = int(model.site_bodyid[target])
                # thrust on the floating base moves no finger
                if body == base or body not in self.bodies:
                    continue
            found = f"actuator {names[k]} that drives no joint and no tendon"
            raise self.refuse(found, "actuators of joints and of fixed tendons")

    def _check_tendons(self) -> None:
        """Raise `HandFileError` for spatial tendons that move the hand."""
        model = self.model
        names = _names(model, "tendon", model.ntendon)
        by_motor = [
            int(np.ravel(model.actuator_trnid[k])[0])
            for k in range(model.nu)
            if int(model.actuator_trntype[k]) == int(self.mujoco.mjtTrn.mjTRN_TENDON)
        ]
        ties = int(self.mujoco.mjtEq.mjEQ_TENDON)
        tied = []
        for k in range(model.neq):
            if int(model.eq_type[k]) == ties and bool(model.eq_active0[k]):
                tied += [int(model.eq_obj1id[k]), int(model.eq_obj2id[k])]
        for k in range(model.ntendon):
            if self._is_fixed(k):
                continue
            if k in by_motor or k in tied:
                allowed = "<fixed> tendons, with the moment arm of each joint as its coef"
                raise self.refuse(f"spatial tendon {names[k]}, which wraps around bodies", allowed)
            self.warnings.append(f"spatial tendon {names[k]} has no motor, and is left out")

    def _equalities(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the equalities of all joints as `A q = b`."""
        model = self.model
        kinds = self.mujoco.mjtEq
        rows = []
        values = []
        names = _names(model, "equality", model.neq)
        inside = np.zeros(model.njnt, dtype=bool)
        inside[self.joints] = True
        for k in range(model.neq):
            kind = int(model.eq_type[k])
            if not bool(model.eq_active0[k]):
                continue
            if kind in (int(kinds.mjEQ_CONNECT), int(kinds.mjEQ_WELD)):
                self._check_loop(k, names[k])
                continue
            if kind not in (int(kinds.mjEQ_JOINT), int(kinds.mjEQ_TENDON)):
                continue
            one = int(model.eq_obj1id[k])
            two = int(model.eq_obj2id[k])
            curve = np.asarray(model.eq_data[k], dtype=float)
            row, start = self._tied(kind, one)
            slope = np.zeros(model.njnt)
            rest = 0.0
            if two >= 0:
                slope, rest = self._tied(kind, two)
            if not (row[inside].any() or slope[inside].any()):
                continue
            if (row[~inside] != 0).any() or (slope[~inside] != 0).any():
                found = f"equality {names[k]} with a joint outside of the hand"
                raise self.refuse(found, "a --root above both")
            if two >= 0 and curve[CURVED].any():
                raise self._curved(kind, names[k], one, two, curve)
            rows.append(row - curve[1] * slope)
            values.append(start + curve[0] - curve[1] * rest)
        return np.array(rows).reshape(-1, model.njnt), np.array(values)

    def _tied(self, kind: int, index: int) -> tuple[np.ndarray, float]:
        """Return what an equality ties, a joint or a tendon, as a sum over joints, and its value in
        the reference posture.
        """
        model = self.model
        if kind == int(self.mujoco.mjtEq.mjEQ_TENDON):
            return self._tendon(index), float(model.tendon_length0[index])
        row = np.zeros(model.njnt)
        row[index] = 1.0
        return row, float(model.qpos0[model.jnt_qposadr[index]])

    def _curved(self, kind: int, name: str, one: int, two: int, curve: np.ndarray) -> HandFileError:
        """Return the error for an equality that is no straight line; it tells the nearest line."""
        model = self.model
        allowed = 'a straight line: polycoef="a b 0 0 0"'
        called = f"equality {name} of tendons"
        if kind == int(self.mujoco.mjtEq.mjEQ_JOINT):
            called = f"equality {name} of {self.joint_names[one]} to {self.joint_names[two]}"
            low, high = model.jnt_range[two].tolist()
            if low < high:
                at = np.linspace(low, high, FIT_POINTS) - float(model.qpos0[model.jnt_qposadr[two]])
                powers = np.stack([at**k for k in range(CURVED.stop)], 1)
                wanted = powers @ curve[: CURVED.stop]
                line = np.linalg.lstsq(powers[:, :STRAIGHT], wanted, rcond=None)[0]
                off = float(np.abs(powers[:, :STRAIGHT] @ line - wanted).max())
                text = f"{line[0]:.4g} {line[1]:.4g} 0 0 0"
                allowed = f'a straight line, the nearest is polycoef="{text}" ({off:.2g} off)'
        degree = int(np.flatnonzero(curve[: CURVED.stop]).max())
        return self.refuse(f"{called} by a polynomial of degree {degree}", allowed)

    def _check_loop(self, equality: int, name: str) -> None:
        """Raise `HandFileError` for an equality that closes a loop of bodies of the hand."""
        model = self.model
        both = [int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])]
        if int(model.eq_objtype[equality]) == int(self.mujoco.mjtObj.mjOBJ_SITE):
            both = [int(model.site_bodyid[site]) for site in both]
        if all(body in self.bodies and body > 0 for body in both):
            found = f"equality {name} that closes a loop of bodies"
            allowed = "a tree: equalities of joints in place of the loop"
            raise self.refuse(found, allowed)
        self.told.append(f"equality {name} to a body beside the hand is left out")

    def _drives(self, pulls: np.ndarray, mechanism: Mechanism) -> dict[int, Drive]:
        """Return limits and effort of every joint of the hand."""
        model = self.model
        found = {}
        forces = [self._force(k) for k in range(model.nu)]
        for column, j in enumerate(self.joints):
            most = 0.0
            least = 0.0
            known = False
            for k in np.flatnonzero(pulls[:, column]).tolist():
                ends = sorted(pulls[k, column] * force for force in forces[k])
                known = known or any(ends)
                most += max(ends[1], 0.0)
                least += min(ends[0], 0.0)
            effort = max(most, -least) if known else 0.0
            if bool(model.jnt_actfrclimited[j]):
                strongest = float(np.abs(model.jnt_actfrcrange[j]).max())
                effort = min(effort or math.inf, strongest)
            low, high = self._range(j, pulls[:, column])
            found[j] = Drive(low, high, effort)
        index = {self.joint_names[j]: j for j in self.joints}
        # a follower without a motor is as strong as its weakest leader makes it
        for name, mimic in mechanism.followers.items():
            j = index[name]
            if found[j].effort or pulls[:, self.joints.index(j)].any():
                continue
            given = [found[index[source]].effort / abs(x) for source, x in mimic.terms]
            found[j] = dataclasses.replace(found[j], effort=min(given))
        return self._within_tendons(found, mechanism)

    def _force(self, actuator: int) -> tuple[float, float]:
        """Return the least and the greatest force of an actuator [N or N m]; zeros if unknown."""
        model = self.model
        if bool(model.actuator_forcelimited[actuator]):
            low, high = np.asarray(model.actuator_forcerange[actuator]).tolist()
            return low, high
        direct = int(model.actuator_gaintype[actuator]) == int(self.mujoco.mjtGain.mjGAIN_FIXED)
        plain = int(model.actuator_biastype[actuator]) == int(self.mujoco.mjtBias.mjBIAS_NONE)
        if direct and plain and bool(model.actuator_ctrllimited[actuator]):
            gain = float(model.actuator_gainprm[actuator][0])
            low, high = np.asarray(model.actuator_ctrlrange[actuator]).tolist()
            return gain * low, gain * high
        return 0.0, 0.0

    def _range(self, joint: int, arms: np.ndarray) -> tuple[float, float]:
        """Return the limits of a joint, else those of the control of its own servo, else infinite
        ones.
        """
        model = self.model
        if bool(model.jnt_limited[joint]):
            low, high = np.asarray(model.jnt_range[joint]).tolist()
            return low, high
        affine = int(self.mujoco.mjtBias.mjBIAS_AFFINE)
        for k in np.flatnonzero(arms).tolist():
            alone = np.count_nonzero(self._pull(k)) == 1
            gain = float(model.actuator_gainprm[k][0])
            servo = int(model.actuator_biastype[k]) == affine
            servo = servo and gain > 0 and float(model.actuator_biasprm[k][1]) == -gain
            if alone and servo and bool(model.actuator_ctrllimited[k]):
                ends = np.asarray(model.actuator_ctrlrange[k]) / arms[k]
                self.told.append(f"joint {self.joint_names[joint]} is limited by its control")
                return float(ends.min()), float(ends.max())
        return -math.inf, math.inf

    def _within_tendons(self, drives: dict[int, Drive], mechanism: Mechanism) -> dict[int, Drive]:
        """Return the drives, with joints narrowed by the limits of tendons that one joint sets."""
        model = self.model
        names = _names(model, "tendon", model.ntendon)
        index = {self.joint_names[j]: j for j in self.joints}
        for k in range(model.ntendon):
            if not (bool(model.tendon_limited[k]) and self._is_fixed(k)):
                continue
            arms = dict[str, float]()
            shift = 0.0
            for j in np.flatnonzero(self._tendon(k)).tolist():
                arm = float(self._tendon(k)[j])
                name = self.joint_names[j]
                mimic = mechanism.followers.get(name)
                shift += arm * (mimic.offset if mimic else mechanism.still.get(name, 0.0))
                terms = mimic.terms if mimic else () if name in mechanism.still else ((name, 1.0),)
                for source, ratio in terms:
                    arms[source] = arms.get(source, 0.0) + arm * ratio
            arms = {name: arm for name, arm in arms.items() if arm and name in index}
            ends = (np.asarray(model.tendon_range[k]) - shift).tolist()
            if len(arms) == 1:
                ((name, arm),) = arms.items()
                old = drives[index[name]]
                low, high = sorted(end / arm for end in ends)
                new = dataclasses.replace(
                    old, lower=max(low, old.lower), upper=min(high, old.upper)
                )
                if new != old and new.lower < new.upper:
                    drives[index[name]] = new
                    self.told.append(f"joint {name} is narrowed by the limits of tendon {names[k]}")
            elif arms:
                self.warnings.append(
                    f"the limits of tendon {names[k]}, a sum of {', '.join(arms)}, are not kept"
                )
        return drives

    def write(
        self,
        folder: Path,
        mechanism: Mechanism,
        name: str,
        tips: Sequence[str],
        visual: bool,
    ) -> str:
        """Return the hand as the text of a URDF; its meshes are written to `folder`."""
        model = self.model
        robot = ET.Element("robot", name=name)
        taken = set(self.names)
        offset = {0: np.zeros(3), self.root: np.zeros(3)}
        sites = _names(model, "site", model.nsite)
        for k in self.bodies:
            own = self._own(k)
            anchor = np.asarray(model.jnt_pos[own[-1]], dtype=float) if own else np.zeros(3)
            offset[k] = anchor if k != self.root else np.zeros(3)
            self._link(robot, k, offset[k], folder, visual)
            if k == self.root:
                continue
            parent = self.names[self.parents[k]]
            pose = _shift(-offset[self.parents[k]])
            pose = pose @ _pose(model.body_pos[k], model.body_quat[k])
            before = np.zeros(3)
            for count, j in enumerate(own):
                child = self.names[k]
                if count < len(own) - 1:
                    child = _unused(f"{self.names[k]}_{self.joint_names[j]}", taken)
                    ET.SubElement(robot, "link", name=child)
                at = np.asarray(model.jnt_pos[j], dtype=float)
                self._joint(robot, j, parent, child, pose @ _shift(at - before), mechanism)
                parent = child
                pose = np.eye(4)
                before = at
            if not own:
                joint = _unused(f"{self.names[k]}_fixed", set(self.joint_names))
                _fixed(robot, joint, parent, self.names[k], pose)
        for k in range(model.nsite):
            body = int(model.site_bodyid[k])
            named = bool(model.site(k).name)
            wanted = sites[k] in tips or TIP in sites[k].lower()
            if not (named and wanted and body in self.bodies) or sites[k] in taken:
                continue
            taken.add(sites[k])
            ET.SubElement(robot, "link", name=sites[k])
            pose = _shift(-offset[body]) @ _pose(model.site_pos[k], model.site_quat[k])
            _fixed(robot, f"{sites[k]}_site", self.names[body], sites[k], pose)
        ET.indent(robot)
        return ET.tostring(robot, encoding="unicode")

    def _joint(
        self,
        robot: ET.Element,
        joint: int,
        parent: str,
        child: str,
        pose: np.ndarray,
        mechanism: Mechanism,
    ) -> None:
        """Add a joint to a URDF; `pose` is that of its frame in the parent at its reference."""
        model = self.model
        name = self.joint_names[joint]
        axis = np.asarray(model.jnt_axis[joint], dtype=float)
        slides = self.slides[joint]
        rest = float(model.qpos0[model.jnt_qposadr[joint]])
        if name in mechanism.still:
            move = _move(slides, axis, mechanism.still[name] - rest)
            _fixed(robot, name, parent, child, pose @ move)
            return
        drive = self.drives[joint]
        kind = "prismatic" if slides else "revolute"
        bounds = {}
        if math.isfinite(drive.upper - drive.lower):
            bounds = {"lower": _number(drive.lower), "upper": _number(drive.upper)}
        elif not slides:
            kind = "continuous"
        element = ET.SubElement(robot, "joint", name=name, type=kind)
        _origin(element, pose @ _move(slides, axis, -rest))
        ET.SubElement(element, "parent", link=parent)
        ET.SubElement(element, "child", link=child)
        ET.SubElement(element, "axis", xyz=_text(axis))
        limit = {"effort": _number(drive.effort), "velocity": "0"}
        ET.SubElement(element, "limit", limit | bounds)

    def _link(
        self, robot: ET.Element, body: int, offset: np.ndarray, folder: Path, visual: bool
    ) -> None:
        """Add a link to a URDF; its frame is at `offset` [m] in the body."""
        model = self.model
        link = ET.SubElement(robot, "link", name=self.names[body])
        mass = float(model.body_mass[body]) if body else 0.0
        if mass > 0:
            turn = _pose(np.zeros(3), model.body_iquat[body])[:3, :3]
            inertia = turn @ np.diag(np.asarray(model.body_inertia[body], dtype=float)) @ turn.T
            element = ET.SubElement(link, "inertial")
            ET.SubElement(element, "origin", xyz=_text(model.body_ipos[body] - offset))
            ET.SubElement(element, "mass", value=_number(mass))
            rows = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2)}
            rows |= {"iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
            values = {key: _number(inertia[at]) for key, at in rows.items()}
            ET.SubElement(element, "inertia", values)
        paired = {*np.ravel(model.pair_geom1).tolist(), *np.ravel(model.pair_geom2).tolist()}
        geoms = np.flatnonzero(model.geom_bodyid == body).tolist()
        for k in geoms if body or self.on_world else ():
            touches = k in paired or bool(model.geom_contype[k]) or bool(model.geom_conaffinity[k])
            # a mesh that is only seen need not be written
            seen = touches or visual
            pose = _shift(-offset) @ _pose(model.geom_pos[k], model.geom_quat[k])
            for kind, sizes, at in self._shapes(k, folder, seen):
                element = ET.SubElement(link, "collision" if touches else "visual")
                _origin(element, pose @ _shift(at))
                ET.SubElement(ET.SubElement(element, "geometry"), kind, sizes)

    def _shapes(
        self, geom: int, folder: Path, write: bool
    ) -> list[tuple[str, dict[str, str], np.ndarray]]:
        """Return the URDF shapes of a geom: kind, sizes, and place [m] in the geom's frame."""
        model = self.model
        kinds = self.mujoco.mjtGeom
        kind = int(model.geom_type[geom])
        x, y, z = np.asarray(model.geom_size[geom], dtype=float).tolist()
        here = np.zeros(3)
        if kind == int(kinds.mjGEOM_BOX):
            return [("box", {"size": _text(np.array([2 * x, 2 * y, 2 * z]))}, here)]
        if kind == int(kinds.mjGEOM_SPHERE):
            return [("sphere", {"radius": _number(x)}, here)]
        if kind in (int(kinds.mjGEOM_CYLINDER), int(kinds.mjGEOM_CAPSULE)):
            shapes = [("cylinder", {"radius": _number(x), "length": _number(2 * y)}, here)]
            if kind == int(kinds.mjGEOM_CAPSULE):
                for end in (-y, y):
                    shapes.append(("sphere", {"radius": _number(x)}, np.array([0.0, 0.0, end])))
            return shapes
        name = f"geom{geom}.stl"
        if kind == int(kinds.mjGEOM_ELLIPSOID):
            surface = trimesh.creation.icosphere(FINENESS)
            surface.apply_scale([x, y, z])
        elif kind == int(kinds.mjGEOM_MESH):
            mesh = int(model.geom_dataid[geom])
            name = f"mesh{mesh}.stl"
            corner = int(model.mesh_vertadr[mesh])
            face = int(model.mesh_faceadr[mesh])
            surface = trimesh.Trimesh(
                model.mesh_vert[corner : corner + int(model.mesh_vertnum[mesh])],
                model.mesh_face[face : face + int(model.mesh_facenum[mesh])],
                process=False,
            )
        else:
            called = model.geom(geom).name or f"of {self.names[int(model.geom_bodyid[geom])]}"
            self.told.append(f"geom {called}, a plane or a field, is left out")
            return []
        if write and not (folder / name).exists():
            surface.export(folder / name)
        return [("mesh", {"filename": name}, here)]

    def tip_links(self) -> tuple[str, ...]:
        """Return the links with a site whose name says that it is at a fingertip; () if they are
        not three to five.
        """
        model = self.model
        touching = {
            int(body)
            for body, one, two in zip(
                model.geom_bodyid, model.geom_contype, model.geom_conaffinity, strict=True
            )
            if one or two
        }
        found = []
        for k in range(model.nsite):
            body = int(model.site_bodyid[k])
            moves = body in self.bodies and body != self.root and body in touching
            if moves and TIP in model.site(k).name.lower():
                found.append(self.names[body])
        links = tuple(dict.fromkeys(found))
        return links if FINGERTIPS[0] <= len(links) <= FINGERTIPS[1] else ()


def _names(model: Any, kind: str, count: int) -> list[str]:
    """Return the names of all elements of a kind; one without a name gets one of its own."""
    given = [getattr(model, kind)(k).name for k in range(count)]
    taken = set(given)
    return [name or _unused(f"{kind}_{k}", taken) for k, name in enumerate(given)]


def _unused(name: str, taken: set[str]) -> str:
    """Return a name that is not taken, and add it to the taken ones."""
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def _pose(position: Any, quaternion: Any) -> np.ndarray:
    """Return the pose (4, 4) [m] of a position and a quaternion (w, x, y, z)."""
    pose = trimesh.transformations.quaternion_matrix(np.asarray(quaternion, dtype=float))
    pose[:3, 3] = position
    return pose


def _shift(by: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) of a translation [m]."""
    return trimesh.transformations.translation_matrix(by)


def _move(slides: bool, axis: np.ndarray, value: float) -> np.ndarray:
    """Return the pose (4, 4) that a joint makes at a value [rad or m]."""
    if slides:
        return _shift(value * axis)
    return np.asarray(trimesh.transformations.rotation_matrix(value, axis))


def _number(x: float) -> str:
    return repr(float(x))


def _text(numbers: Any) -> str:
    return " ".join(repr(x) for x in np.asarray(numbers, dtype=float).tolist())


def _origin(element: ET.Element, pose: np.ndarray) -> None:
    """Add the origin of a pose (4, 4) [m] to an element of a URDF."""
    xyz, rpy = place(pose)
    ET.SubElement(element, "origin", xyz=_text(xyz), rpy=_text(rpy))


def _fixed(robot: ET.Element, name: str, parent: str, child: str, pose: np.ndarray) -> None:
    """Add a fixed joint to a URDF."""
    element = ET.SubElement(robot, "joint", name=name, type="fixed")
    _origin(element, pose)
    ET.SubElement(element, "parent", link=parent)
    ET.SubElement(element, "child", link=child)
