"""Grip by the load that is felt: just enough force for a weight and a friction that nobody told.

The fingertips feel the load. `LeastForces` carries it within the friction believed, which sliding fingertips revise.
The joints press with these forces, most of the load included, so that the hand does not sag.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.holding.force import RAMP, held_forces
from torchgrasp.control.holding.friction import CREEP_CUTOFF, CREEPING, LEAST_STD, SLIPPING, FrictionBelief
from torchgrasp.control.holding.least_forces import Balance, LeastForces, balance, friction_ratios
from torchgrasp.control.observation import Observation
from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.state import Part
from torchgrasp.control.tactile import low_pass
from torchgrasp.errors import Status

FRICTION = 0.8
"""Mean of the friction before anything is felt: that of a grasp's plan by default (`ContactSpec`)."""

BORNE = 1000.0
"""Largest normal force of a finger [N] on an object that bears any: no hand presses as hard."""

LEAST_PUSH = 0.4
"""Least normal force of a finger [N]: four standard deviations of its reading."""

LOAD_CUTOFF, CARRY_CUTOFF, RATIO_CUTOFF, PLACE_CUTOFF = 3.0, 0.7, 8.0, 1.0
"""Cut-offs [Hz] of the load that grip has to bear, of that which the drives carry, of the forces behind a ratio, and
of the sensed normals, whose noise is the largest. A faster carrying rocks what is held."""

CARRIED = 0.8
"""Share of the felt load that the drives carry: the object sags by a fifth. All of it would press ever harder on a
table that does not yield."""

LONGEST_ARM = 0.1
"""Longest arm [m] of the felt load about the contacts: a table's reaction may have a longer one."""

LIFTED, STEADY, GREW = 0.35, 0.3, 1.05
"""Load [N] from which the object counts as lifted; time [s] for which the load may not have grown by this factor, nor
a fingertip have slid, before forces fall."""

RELEASE, PROBING = 3.0, 0.1
"""Rate [1/s] at which forces fall to what suffices, and rate [1/s] at which less safe ratios are tried after that."""

RAISE = 240.0
"""How much harder a sliding finger presses by the way it slides [1/m]: twice as hard every 3 mm."""

ENOUGH, SPARE = 3.0, 0.5
"""Sum of the normal forces, over what the felt load and this [N] more ask for at the friction believed, from which more
force is not sought: beyond, the squeeze itself moves the object. Then ratios nearer to the friction are aimed at."""

RELAX = 2.0
"""Rate [1/s] at which the ratio that is aimed at changes."""

LESSON = 1.3
"""Multiple of the force at which a finger began to slide after a release: it does not fall below that again."""

SLID = 0.03
"""Time [s] of sliding after which its ratio
of forces is that of its friction: until then the filtered forces lag."""

FLOOR = 0.8
"""Largest force of a balanced set above all floors, over what a finger may press at most: the load needs the rest."""

WEAKEST = 0.01
"""Least planned normal force, over the largest, that counts: no multiple of less lifts a finger above its floor."""

RISE = 60.0
"""Fastest rise of a force [N/s]: a light touch becomes a firm grip in 0.1 s."""

TRACKING, MOST_TRIM = 4.0, 0.5
"""Rate [1/s] at which the normal forces that are felt are brought to the wanted ones by internal forces, which move
nothing, and the bound of these, over the largest wanted force."""

AT_LIMIT, OVERLOADED = 0.95, 0.25
"""Share of the limits at which forces count as at them, and time [s] for which a fingertip slides there before the load
is too heavy. What slides is felt to weigh no more than the limits bear, so that it hardly asks for more than them."""


class GripHold(Part):
    """Press with the least forces that carry the felt load.

    `status` turns `TOO_HEAVY` when a fingertip slides at the limits of torque or force: put the hand down then.
    `weight` [N] is the load that is felt.

    Args:
        reference, observation, start: as for `ForceHold`; no finger presses harder than `reference.max_force`.
    """

    def __init__(self, reference: ClosingReference, observation: Observation, start: Float[Tensor, " j"]) -> None:
        max_force = BORNE if reference.max_force is None else reference.max_force
        hand = reference.hand
        self.reference, self.start, self.rest = reference, start, observation.joints
        effort = np.array([hand.actuators[name].effort for name in hand.tree.joint_names])
        forces, _ = held_forces(reference, observation)
        self.normals, self.radius = self._sensed(observation, reference.normals.numpy()), hand.tips.radius.numpy()
        self.solver = LeastForces(forces.numpy().copy(), effort, max_force)
        push = np.abs((forces.numpy() * self.normals).sum(-1))
        self.planned = np.maximum(push, WEAKEST * max(float(push.max()), LEAST_PUSH))
        self.grip, self.least = np.minimum(push, max_force), np.full(len(push), LEAST_PUSH)
        self.felt, self.load, self.carried = np.zeros((len(push), 3)), np.zeros(6), np.zeros(6)
        self.up = None if reference.table is None else reference.table.normal.numpy()
        self.friction, self.optimism = FrictionBelief(FRICTION), 0.0
        self.aim = self.friction.low
        self.sent, self.trim, self.most = *np.zeros((2, len(push), 3)), 0.0
        self.time = self.steady = self.over = 0.0
        self.released = False
        self.status, self.slid, self.creep = Status.OK, *np.zeros((2, len(push)))

    @property
    def weight(self) -> float:
        """The load that is felt [N]."""
        return float(np.linalg.norm(self.load[:3]))

    def __call__(self, observation: Observation, period: float) -> Float[Tensor, " j"]:
        """Return the targets of all joints for the next tick."""
        self.time += period
        jacobian = observation.jacobian.numpy()
        contacts = self._feel(observation, period)
        self._learn(observation, period)
        wanted = self.solver.solve(contacts, self.normals, jacobian, self.load, self.aim, self._floor())
        self._judge(wanted, jacobian, period)
        step = self._command(contacts, wanted, period) - self.sent
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        self.sent = self.sent + step * np.minimum(1.0, RISE * period / np.maximum(length, 1e-9))
        torque = np.einsum("cij,ci->j", jacobian, self.sent).clip(-self.solver.effort, self.solver.effort)
        share = min(self.time / RAMP, 1.0)
        lead = torch.from_numpy(torque) / self.reference.kp
        return self.start + share * (self.rest + lead - self.start)

    def _floor(self) -> np.ndarray:
        """Return the least normal forces [N]; planned forces above them stay within the limit."""
        floor = np.maximum(self.grip, self.least)
        largest = float((floor / self.planned).max() * self.planned.max())
        return floor * min(1.0, FLOOR * self.solver.most / largest)

    def _command(self, contacts: Balance, wanted: np.ndarray, period: float) -> np.ndarray:
        """Return forces for the drives: the fingers' deflection bears what they do not carry."""
        if self.time > RAMP:
            lacking = ((self.felt - wanted) * self.normals).sum(-1)
            self.trim = self.trim - period * TRACKING * lacking[:, None] * self.normals
            flat = self.trim.ravel()
            self.trim = (flat - contacts.inverse @ (contacts.wrench @ flat)).reshape(-1, 3)
            largest, bound = (float(np.linalg.norm(x, axis=-1).max()) for x in (self.trim, MOST_TRIM * wanted))
            self.trim = self.trim * min(1.0, bound / max(largest, 1e-9))
        return wanted + self.trim - (contacts.inverse @ (self.load - CARRIED * self.carried)).reshape(-1, 3)

    def _feel(self, observation: Observation, period: float) -> Balance:
        """Filter forces, load and normals; return how forces sum up where the fingertips touch."""
        normals = self._sensed(observation, self.normals)
        self.normals = self.normals + low_pass(PLACE_CUTOFF, period) * (normals - self.normals)
        self.normals /= np.linalg.norm(self.normals, axis=-1, keepdims=True)
        contacts = balance(observation.tips.numpy() - self.radius[:, None] * self.normals)
        forces = observation.tactile.forces.numpy()
        self.felt = self.felt + low_pass(RATIO_CUTOFF, period) * (forces - self.felt)
        load = self._weight(contacts.wrench @ forces.ravel())
        self.load = self.load + low_pass(LOAD_CUTOFF, period) * (load - self.load)
        self.carried = self.carried + low_pass(CARRY_CUTOFF, period) * (load - self.carried)
        return contacts

    def _weight(self, load: np.ndarray) -> np.ndarray:
        """Return the part of a load that may be a weight: upwards, if a table is known, which bears the rest."""
        if self.up is None:
            return load
        lifted = max(float(load[:3] @ self.up), 0.0)
        torque = load[3:] * min(1.0, LONGEST_ARM * lifted / max(float(np.linalg.norm(load[3:])), 1e-9))
        return np.concatenate([lifted * self.up, torque])

    def _learn(self, observation: Observation, period: float) -> None:
        """Press harder where a finger slides, revise the friction, and release what is more than enough."""
        speed = observation.tactile.sliding.numpy()
        self.creep = self.creep + low_pass(CREEP_CUTOFF, period) * (speed.clip(max=SLIPPING) - self.creep)
        slides = (speed > SLIPPING) & observation.tactile.contact.numpy()
        starts = slides & (self.slid == 0.0)
        self.slid = np.where(slides, self.slid + period, 0.0)
        if self.time < RAMP:
            return
        push = -(self.felt * self.normals).sum(-1)
        creeps = self.creep > CREEPING
        learns = (starts | creeps) & self.released
        self.least = np.where(learns, np.maximum(self.least, LESSON * np.minimum(push, self.grip)), self.least)
        ratios = friction_ratios(self.felt, self.normals)
        pressing = push > 0.5 * LEAST_PUSH
        for i in np.flatnonzero(slides & pressing):
            self.friction.slides(float(min(ratios[i], 2.0)), float(push[i]), bool(self.slid[i] <= SLID))
        if slides.any():
            harder = np.maximum(self.grip, push) * (1 + RAISE * period * speed.clip(min=0.0))
            harder = np.where(slides, harder, self.grip)
            self.grip = np.maximum(self.grip, harder * min(1.0, self._enough() / float(harder.sum())))
        moving = bool((slides | creeps | ~pressing).any())
        if moving:
            self.optimism = 0.0
        if moving or self.weight > GREW * self.most:
            self.most, self.steady = max(self.most, self.weight), 0.0
        self.steady += period
        if self.steady < STEADY or self.weight < LIFTED:
            return
        self.released = True
        self.grip = np.maximum(self.grip * (1 - min(RELEASE * period, 1.0)), np.minimum(self.least, self.grip))
        if self.friction.std > 2 * LEAST_STD and bool((self.grip < 1.2 * self.least).all()):
            self.optimism += PROBING * period

    def _enough(self) -> float:
        """Return a sum of normal forces [N] that is enough for the felt load."""
        return ENOUGH * (self.weight + SPARE) / self.friction.low

    def _judge(self, wanted: np.ndarray, jacobian: np.ndarray, period: float) -> None:
        """Choose the ratio to aim at, and find out whether the load is too heavy.

        It is too heavy where a finger slides at the limits. Until then they prove nothing: friction and normals are
        beliefs, and may be better.
        """
        share, push = self.solver.share(self.normals, jacobian), -float((wanted * self.normals).sum())
        goal = min(self.friction.low + self.optimism, self.friction.high)
        if share > 1.0 or push > max(self._enough(), float(self.grip.sum())):
            goal = self.friction.high
        self.aim += min(max(goal - self.aim, -RELAX * period), RELAX * period)
        beyond = share > AT_LIMIT and bool((self.slid > SLID).any())
        self.over = self.over + period if beyond and self.weight > LIFTED else 0.0
        if self.over > OVERLOADED:
            self.status = Status.TOO_HEAVY

    @staticmethod
    def _sensed(observation: Observation, normals: np.ndarray) -> np.ndarray:
        """Return the sensed normals, or given ones where nothing is sensed."""
        sensed = observation.tactile.normals.numpy()
        return np.where(np.isfinite(sensed).all(-1, keepdims=True), sensed, normals)
