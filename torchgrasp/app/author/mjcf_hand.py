"""The part of a compiled MuJoCo model that is a hand: its bodies, its joints, and their drives."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchgrasp.app.author.tendons import Contradiction, Joints, Mechanism, couple_joints
from torchgrasp.foundation.base import FINGERTIPS
from torchgrasp.foundation.errors import BadArgument, HandFileError

STRAIGHT = 2  # coefficients of a polynomial of degree one
CURVED = slice(2, 5)  # further coefficients of an equality of joints in MuJoCo
FIT_POINTS = 101  # positions at which a straight line is fitted to a polynomial
SAME = 1e-3  # greatest difference of limits that count as one, as a share of the range
TIP = "tip"  # in the name of a site at a fingertip


@dataclasses.dataclass(frozen=True)
class Drive:
    """Limits `lower` and `upper` [rad or m] and greatest `effort` [N m or N] of a joint.

    Limits that the file lacks are infinite, and an effort that it lacks is 0.
    """

    lower: float
    upper: float
    effort: float


class ModelHand:
    """The part of a compiled MuJoCo model that is a hand, and its joints; `choose` finds them.

    Args:
        mujoco: the module `mujoco`.
        model: the compiled model, an `MjModel`.
        path: path of the MJCF, which errors name.

    Attributes:
        bodies: indices of the bodies of the hand, parents first; a world body that is kept is 0.
        joints: indices of their hinge and slide joints, in the order of the bodies.
        root: index of the body at the root of the hand; 0 for the world.
        on_world: whether the fingers are fixed to the world, whose shapes are then the palm.
        parents, names: the parent's index and the name of each body of the model.
        owners, joint_names: the body's index and the name of each joint of the model.
        told: sentences for the user on how the hand becomes a URDF.
        warnings: sentences for the user on what the URDF lacks and the hand may need.
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
        self.owners = model.jnt_bodyid.tolist()
        self.names = names_of(model, "body", model.nbody)
        self.joint_names = names_of(model, "joint", model.njnt)
        kinds = mujoco.mjtJoint
        self.slides = [kind == kinds.mjJNT_SLIDE for kind in model.jnt_type.tolist()]
        self.free = [kind == kinds.mjJNT_FREE for kind in model.jnt_type.tolist()]
        scalar = kinds.mjJNT_HINGE, kinds.mjJNT_SLIDE
        self.scalar = [kind in scalar for kind in model.jnt_type.tolist()]
        # how each actuator drives, and the joint, tendon or site that it drives
        self.transmissions = model.actuator_trntype.tolist()
        self.targets = model.actuator_trnid[:, 0].tolist()

    def refuse(self, found: str, allowed: str) -> HandFileError:
        """Return the error to raise if the file has `found` in place of `allowed`."""
        return HandFileError("mjcf", f"{self.path}: {found}", allowed)

    def choose(self, root: str) -> None:
        """Choose the bodies of the hand and the joints between them, and set the attributes.

        A base is a direct child of the world body that is, or carries, a body with a driven joint.
        If one of them carries three fingers or more, the others are left out. A single base is the
        root of the hand, unless a hinge or slide joint moves it. Otherwise the world is the root,
        and with several bases its bodies that stand still are the palm. `root` names a body of the
        hand if the model has several hands; "" if not.

        Raises `HandFileError` for several hands without a `root`, for a hand without an actuator,
        and for ball joints. Raises `BadArgument` for an unknown `root`.
        """
        tops = self._tops()
        every = range(1, self.model.nbody)
        driven = self._driven(tops, root)
        single = len(driven) == 1
        if not single:
            # fingers on the world itself: its other bodies that stand still are the palm
            moving = {tops[k] for k in self.owners}
            driven += [k for k in every if tops[k] == k and k not in moving]
        self.bodies = [k for k in every if tops[k] in driven]
        self.on_world = not single
        self.root = driven[0] if single and not self.own_joints(driven[0]) else 0
        if not self.root:
            self.bodies.insert(0, 0)
        left = [self.names[k] for k in every if tops[k] == k and k not in driven]
        if left:
            self.told.append(f"bodies beside the hand are left out: {', '.join(left)}")
        for k in self.bodies:
            self._take_joints(k)

    def _tops(self) -> list[int]:
        """Return for each body the body of the world that it is or hangs on; 0 for the world."""
        tops = [0]
        for k in range(1, self.model.nbody):
            tops.append(tops[self.parents[k]] or k)
        return tops

    def _driven(self, tops: Sequence[int], root: str) -> list[int]:
        """Return the bodies of the world below which the joints of the hand are.

        `tops` is what `_tops` returns; `root` is the name of a body of the hand, or "".
        """
        moved = self._moved()
        if not moved.any():
            allowed = 'an actuator for every motor, as <position joint="..."/> in <actuator>'
            raise self.refuse("no actuator that moves a joint or a fixed tendon", allowed)
        driven = list(dict.fromkeys(tops[self.owners[k]] for k in np.flatnonzero(moved).tolist()))
        if root:
            if root not in self.names:
                bodies = f"a body of {self.path}: {sorted(self.names)}"
                raise BadArgument("root", repr(root), bodies)
            driven = [tops[self.names.index(root)]]
        hands = [k for k in driven if self._ends(k, tops) >= FINGERTIPS[0]]
        if len(hands) > 1:
            names = " and ".join(self.names[k] for k in hands)
            raise self.refuse(f"several hands, {names}", "one hand: --root BODY chooses one")
        return hands or driven

    def _take_joints(self, body: int) -> None:
        """Add the joints between a body and its parent to those of the hand."""
        for j in (j for j, owner in enumerate(self.owners) if owner == body):
            if self.free[j]:
                name = self.names[body]
                self.told.append(f"the free joint of {name} is dropped: the hand starts there")
            elif self.scalar[j]:
                self.joints.append(j)
            else:
                found = f"joint {self.joint_names[j]} is a ball joint"
                raise self.refuse(found, "hinges and slides: three hinges for a ball joint")

    def own_joints(self, body: int) -> list[int]:
        """Return the indices of the hinge and slide joints between a body and its parent.

        `body` is the index of the body in the model.
        """
        own = [j for j, owner in enumerate(self.owners) if owner == body]
        return [j for j in own if self.scalar[j]]

    def _ends(self, first: int, tops: Sequence[int]) -> int:
        """Return the number of branches below a body of the world that joints move."""
        inside = [k for k in range(1, self.model.nbody) if tops[k] == first]
        count = 0
        for k in inside:
            if k in self.parents:
                continue
            while k and not self.own_joints(k):
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
        kind = self.transmissions[actuator]
        target = self.targets[actuator]
        row = np.zeros(model.njnt)
        gear = float(model.actuator_gear[actuator, 0])
        if kind in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT):
            row[target] = gear
        elif kind == kinds.mjTRN_TENDON:
            row = gear * self._tendon(target)
        return row

    def _is_fixed(self, tendon: int) -> bool:
        first = int(self.model.tendon_adr[tendon])
        kind = int(self.model.wrap_type[first])
        return kind == self.mujoco.mjtWrap.mjWRAP_JOINT

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
        """Return which joints of the hand lead, which follow others, and which stand still.

        A motor sets a leading joint; others follow by linear coupling. Actuators may drive joints
        and fixed tendons; linear equalities may tie them to each other. Raises `HandFileError` for
        other elements that move the hand, such as spatial tendons or a closed loop of bodies.
        Raises it also for equalities that contradict each other.
        """
        model = self.model
        own = self.joints
        names = tuple(self.joint_names[j] for j in own)
        pulls = self._pulls()
        self._check_actuators()
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
            return couple_joints(mechanics, equal[:, own], values, pulls[pulls.any(1)])
        except Contradiction as error:
            found = f"equalities of the joints {error} that no posture obeys"
            raise self.refuse(found, "equalities that agree with each other") from error

    def _pulls(self) -> np.ndarray:
        """Return the moment arms of all actuators on the joints of the hand, a row for each."""
        return np.array([self._pull(k) for k in range(self.model.nu)])[:, self.joints]

    def _check_actuators(self) -> None:
        """Raise `HandFileError` for an actuator of the hand that moves it in another way."""
        model = self.model
        kinds = self.mujoco.mjtTrn
        base = self.root or -1
        plain = kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT, kinds.mjTRN_TENDON
        names = names_of(model, "actuator", model.nu)
        for k, (kind, target) in enumerate(zip(self.transmissions, self.targets, strict=True)):
            if kind in plain or kind == kinds.mjTRN_BODY:
                continue
            if kind == kinds.mjTRN_SITE:
                body = int(model.site_bodyid[target])
                # thrust on the floating base moves no finger
                if body == base or body not in self.bodies:
                    continue
            found = f"actuator {names[k]} that drives no joint and no tendon"
            raise self.refuse(found, "actuators of joints and of fixed tendons")

    def _check_tendons(self) -> None:
        """Raise `HandFileError` for spatial tendons that move the hand."""
        model = self.model
        names = names_of(model, "tendon", model.ntendon)
        by_tendon = self.mujoco.mjtTrn.mjTRN_TENDON
        drives = zip(self.transmissions, self.targets, strict=True)
        by_motor = [target for kind, target in drives if kind == by_tendon]
        ties = self.mujoco.mjtEq.mjEQ_TENDON
        tied = []
        for k in range(model.neq):
            if model.eq_type[k] == ties and model.eq_active0[k]:
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
        names = names_of(model, "equality", model.neq)
        inside = np.zeros(model.njnt, dtype=bool)
        inside[self.joints] = True
        for k in range(model.neq):
            kind = int(model.eq_type[k])
            if not model.eq_active0[k]:
                continue
            if kind in (kinds.mjEQ_CONNECT, kinds.mjEQ_WELD):
                self._check_loop(k, names[k])
                continue
            if kind not in (kinds.mjEQ_JOINT, kinds.mjEQ_TENDON):
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
        """Return what an equality ties, a joint or a tendon, as a sum over joints. Return also its
        value in the reference posture.
        """
        model = self.model
        if kind == self.mujoco.mjtEq.mjEQ_TENDON:
            return self._tendon(index), float(model.tendon_length0[index])
        row = np.zeros(model.njnt)
        row[index] = 1.0
        return row, float(model.qpos0[model.jnt_qposadr[index]])

    def _curved(self, kind: int, name: str, one: int, two: int, curve: np.ndarray) -> HandFileError:
        """Return the error for an equality that is no straight line; it tells the nearest line."""
        model = self.model
        allowed = 'a straight line: polycoef="a b 0 0 0"'
        called = f"equality {name} of tendons"
        if kind == self.mujoco.mjtEq.mjEQ_JOINT:
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
        if model.eq_objtype[equality] == self.mujoco.mjtObj.mjOBJ_SITE:
            both = [int(model.site_bodyid[site]) for site in both]
        if all(body in self.bodies and body > 0 for body in both):
            found = f"equality {name} that closes a loop of bodies"
            allowed = "a tree: equalities of joints in place of the loop"
            raise self.refuse(found, allowed)
        self.told.append(f"equality {name} to a body beside the hand is left out")

    def drives(self, mechanism: Mechanism) -> dict[int, Drive]:
        """Return limits and effort of every joint of the hand, by the joint's index in the model.

        Limits of controls and of tendons narrow those of the joints. `mechanism`, from `couple`,
        says which joints lead and how the others follow.
        """
        pulls = self._pulls()
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
            if model.jnt_actfrclimited[j]:
                strongest = float(np.abs(model.jnt_actfrcrange[j]).max())
                effort = min(effort or math.inf, strongest)
            low, high = self._range(j, pulls[:, column])
            found[j] = Drive(low, high, effort)
        index = {self.joint_names[j]: j for j in self.joints}
        moved = {j: bool(pulls[:, column].any()) for column, j in enumerate(self.joints)}
        # a leader without a motor is as strong as the motors of its followers make it
        weak = {j for j, drive in found.items() if not moved[j] and not drive.effort}
        for name, mimic in mechanism.followers.items():
            pulling = found[index[name]].effort if moved[index[name]] else 0.0
            for source, ratio in mimic.terms:
                j = index[source]
                if j in weak:
                    effort = found[j].effort + abs(ratio) * pulling
                    found[j] = dataclasses.replace(found[j], effort=effort)
        # a follower without a motor is as strong as its weakest leader makes it
        for name, mimic in mechanism.followers.items():
            j = index[name]
            if found[j].effort or moved[j]:
                continue
            given = [found[index[source]].effort / abs(x) for source, x in mimic.terms]
            found[j] = dataclasses.replace(found[j], effort=min(given))
        return self._within_control(self._within_tendons(found, mechanism), mechanism)

    def _force(self, actuator: int) -> tuple[float, float]:
        """Return the least and the greatest force of an actuator [N or N m]; zeros if unknown."""
        model = self.model
        if model.actuator_forcelimited[actuator]:
            low, high = np.asarray(model.actuator_forcerange[actuator]).tolist()
            return low, high
        direct = model.actuator_gaintype[actuator] == self.mujoco.mjtGain.mjGAIN_FIXED
        plain = model.actuator_biastype[actuator] == self.mujoco.mjtBias.mjBIAS_NONE
        if direct and plain and model.actuator_ctrllimited[actuator]:
            gain = float(model.actuator_gainprm[actuator][0])
            low, high = np.asarray(model.actuator_ctrlrange[actuator]).tolist()
            return gain * low, gain * high
        return 0.0, 0.0

    def _range(self, joint: int, arms: np.ndarray) -> tuple[float, float]:
        """Return the limits of a joint, else those of the control of its own servo, else infinite
        ones.
        """
        model = self.model
        if model.jnt_limited[joint]:
            low, high = np.asarray(model.jnt_range[joint]).tolist()
            return low, high
        for k in np.flatnonzero(arms).tolist():
            ends = self._reach(k)
            if ends is not None and np.count_nonzero(self._pull(k)) == 1:
                low, high = sorted(end / float(arms[k]) for end in ends)
                self.told.append(f"joint {self.joint_names[joint]} is limited by its control")
                return low, high
        return -math.inf, math.inf

    def _reach(self, actuator: int) -> tuple[float, float] | None:
        """Return the ends between which a position servo can hold what it drives [rad or m]; None
        for other actuators, and for a control without limits.
        """
        model = self.model
        gain = float(model.actuator_gainprm[actuator][0])
        start, slope = np.asarray(model.actuator_biasprm[actuator][:2], dtype=float).tolist()
        affine = model.actuator_biastype[actuator] == self.mujoco.mjtBias.mjBIAS_AFFINE
        fixed = model.actuator_gaintype[actuator] == self.mujoco.mjtGain.mjGAIN_FIXED
        if not (affine and fixed and gain > 0 and slope < 0):
            return None
        ends = model.actuator_ctrlrange[actuator]
        limited = model.actuator_ctrllimited[actuator]
        # the control of an integrator is a speed, and its state is the position
        if model.actuator_dyntype[actuator] == self.mujoco.mjtDyn.mjDYN_INTEGRATOR:
            ends = model.actuator_actrange[actuator]
            limited = model.actuator_actlimited[actuator]
        if not limited:
            return None
        low, high = ((gain * np.asarray(ends, dtype=float) + start) / -slope).tolist()
        return low, high

    def _within_control(self, drives: dict[int, Drive], mechanism: Mechanism) -> dict[int, Drive]:
        """Return the drives, with joints narrowed to where their own servo can hold them."""
        names = names_of(self.model, "actuator", self.model.nu)
        for k in range(self.model.nu):
            ends = self._reach(k)
            if ends is not None:
                row = self._pull(k)
                self._narrow(drives, row, ends, mechanism, f"the control of {names[k]}")
        return drives

    def _narrow(
        self,
        drives: dict[int, Drive],
        row: np.ndarray,
        ends: Sequence[float],
        mechanism: Mechanism,
        what: str,
    ) -> None:
        """Narrow the limits of the joint that alone sets a sum over joints, which lies between two
        ends.

        `row` holds the factors of all joints in the sum. `what` has these ends in sentences. A sum
        of several joints that can leave its ends is told.
        """
        index = {self.joint_names[j]: j for j in self.joints}
        every, shift = self._leading_arms(row, mechanism)
        arms = {name: arm for name, arm in every.items() if arm and name in index}
        free = [end - shift for end in ends]
        if len(arms) == 1:
            ((name, arm),) = arms.items()
            old = drives[index[name]]
            low, high = sorted(end / arm for end in free)
            # a range that is rounded in the file is that of the joint
            least = SAME * (old.upper - old.lower)
            low = old.lower if low < old.lower + least else low
            high = old.upper if high > old.upper - least else high
            new = dataclasses.replace(old, lower=low, upper=high)
            if new != old and new.lower < new.upper:
                drives[index[name]] = new
                self.told.append(f"joint {name} is narrowed by {what}")
            return
        spans = list[tuple[float, float]]()
        for name, arm in arms.items():
            drive = drives[index[name]]
            low, high = sorted((arm * drive.lower, arm * drive.upper))
            spans.append((low, high))
        low, high = (sum(span) for span in zip(*spans, strict=True)) if spans else (0.0, 0.0)
        least = SAME * (high - low)
        if spans and (low < min(free) - least or high > max(free) + least):
            self.warnings.append(f"not kept: {what}, on a sum of {', '.join(arms)}")

    def _within_tendons(self, drives: dict[int, Drive], mechanism: Mechanism) -> dict[int, Drive]:
        """Return the drives, with joints narrowed by the limits of tendons that one joint sets."""
        model = self.model
        names = names_of(model, "tendon", model.ntendon)
        for k in range(model.ntendon):
            if model.tendon_limited[k] and self._is_fixed(k):
                ends = np.asarray(model.tendon_range[k]).tolist()
                what = f"the limits of tendon {names[k]}"
                self._narrow(drives, self._tendon(k), ends, mechanism, what)
        return drives

    def _leading_arms(
        self, row: np.ndarray, mechanism: Mechanism
    ) -> tuple[dict[str, float], float]:
        """Return the factor of each leading joint by name in a sum over joints with the factors
        `row`. Return also the part of the sum that no joint changes.
        """
        arms = dict[str, float]()
        shift = 0.0
        for j in np.flatnonzero(row).tolist():
            arm = float(row[j])
            name = self.joint_names[j]
            mimic = mechanism.followers.get(name)
            if mimic is not None:
                shift += arm * mimic.offset
                for source, ratio in mimic.terms:
                    arms[source] = arms.get(source, 0.0) + arm * ratio
            elif name in mechanism.still:
                shift += arm * mechanism.still[name]
            else:
                arms[name] = arms.get(name, 0.0) + arm
        return arms, shift

    def tip_links(self) -> tuple[str, ...]:
        """Return the names of the links with a site whose name contains "tip". Return () if they
        are not three to five.
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


def names_of(model: Any, kind: str, count: int) -> list[str]:
    """Return the names of all elements of a kind, such as "body", in a compiled MuJoCo model.

    They are in the order of the model, and `count` is their number. An element without a name gets
    a new one, such as "body_3".
    """
    given = [getattr(model, kind)(k).name for k in range(count)]
    taken = set(given)
    return [name or unused_name(f"{kind}_{k}", taken) for k, name in enumerate(given)]


def unused_name(name: str, taken: set[str]) -> str:
    """Return a name that is not in the set `taken`, and add it to this set.

    It is `name`, with as many underscores behind it as are needed.
    """
    while name in taken:
        name += "_"
    taken.add(name)
    return name
