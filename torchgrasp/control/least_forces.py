"""The least fingertip forces that carry a load, by a barrier method with a few Newton steps per
tick.

Let n_i be normal forces above floor_i, t_i tangential forces, tau_j joint torques, and mu the
friction coefficient. With a small weight eps of the barrier, the method minimises

    sum n_i + penalty sum max(|tau_j| / effort_j - knee, 0)^2
        - eps sum [log(mu^2 (n_i - reserve_i)^2 - |t_i|^2) + log(n_i - floor_i)]

over all forces that balance the load. A reserve is a part of the normal force that does not count
for friction. With it, a force stays within its cone when a push changes it. A load is a wrench
(6,): force [N], then torque [N m] about the centroid of the contacts. All vectors are in one frame,
the hand's. f counts the contacts, and j the joints of the URDF. It is written in NumPy, whose calls
cost less than torch's for small matrices.
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float

from torchgrasp.contacts.balance import grasp_map

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class BarrierNumbers:
    """Parameters of the barrier method that finds the least fingertip forces."""

    penalty: float = 500.0
    """Weight [N] of the penalty on joint torques and normal forces."""
    knee: float = 0.9
    """Share of the limits of torque and force above which the penalty begins."""
    gap: float = 0.01
    """Weight of the barrier, as a share of the load and of the fingers' least normal forces [N].
    With a larger one the forces stay farther from the borders of the cones.
    """
    growth: float = 0.02
    """Least multiple of the solver's internal forces `start` that is tried besides 0. It is added
    to the last forces, which may be too small for the load. Each later multiple is twice the one
    before.
    """
    growths: int = 9
    """Number of these multiples that are tried."""
    margin: float = 1.25
    """Least ratio of the friction coefficient to that which the internal forces need: below it the
    forces would grow huge.
    """
    steps: int = 8
    """Greatest number of Newton steps of one call."""
    strides: int = 8
    """Number of step lengths that are tried, each twice the one before."""
    solved: float = 0.3
    """Newton decrement at which the steps end."""
    lower: float = 0.5
    """If no forces reach a finger's least normal force (its floor), the floor is lowered. It
    becomes this share of the normal force that was found.
    """
    raised: float = 1.05
    """Ratio of a raised friction coefficient to the least coefficient with which forces were found.
    """
    rank: float = 1e-12
    """Least singular value of a grasp map, as a share of the largest; contacts on one line have
    rank 5.
    """
    least: float = 1e-12
    """Least normal force [N] that is used as a divisor."""
    ridge: float = 1e-9
    """Added to the diagonal of the Hessian before it is solved."""


BARRIER = BarrierNumbers()


class Balance(NamedTuple):
    """The grasp map of f contacts, with its pseudo-inverse and null space.

    `wrench` maps the n = 3 f components [N] of the contact forces on the object to a wrench. This
    is a force [N], then a torque [N m] about the contacts' centroid, in the frame of the forces.
    `wrench` has no unit in the first three lines, and [m] in the others. The columns of `inverse`
    are the least forces for each component of the wrench. The columns of `free` are an orthonormal
    basis of the null space: k internal forces, which exert no wrench. The columns of `wrench` are 0
    for a finger in the air, so its force is free, too.
    """

    wrench: Float[Array, "6 n"]
    inverse: Float[Array, "n 6"]
    free: Float[Array, "n k"]

    def inner(self, forces: Float[Array, "f 3"]) -> Float[Array, "f 3"]:
        """Return the internal part (f, 3) [N] of contact `forces` [N]: their projection on the null
        space, which exerts no wrench.
        """
        return (self.free @ (self.free.T @ forces.ravel())).reshape(-1, 3)


def balance(points: Float[Array, "f 3"], touching: Bool[Array, "f"] | bool = True) -> Balance:
    """Return the grasp map at f contact `points` [m], its pseudo-inverse and its null space, from
    one SVD.

    The forces that it maps are in the frame of the points. `touching` marks the fingers that touch;
    True means all.
    """
    columns = np.repeat(np.broadcast_to(touching, len(points)), 3)
    wrench = grasp_map(torch.from_numpy(points)).numpy() * columns
    left, values, right = np.linalg.svd(wrench)
    rank = int((values > BARRIER.rank * values[0]).sum())
    inverse = (right[:rank].T / values[:rank]) @ left[:, :rank].T  # (n, 6)
    return Balance(wrench, inverse, right[rank:].T)


def friction_ratios(forces: Float[Array, "f 3"], normals: Float[Array, "f 3"]) -> Float[Array, "f"]:
    """Return each finger's ratio of tangential to normal force; it is infinite if the finger does
    not press.

    `forces` [N] act on the object, and `normals` are outward unit vectors, both in one frame. f
    counts fingers.
    """
    push = -(forces * normals).sum(-1)
    slide = np.linalg.norm(forces + push[:, None] * normals, axis=-1)
    return np.where(push > 0, slide / np.maximum(push, BARRIER.least), np.inf)


class LeastForces:
    """A solver for the least fingertip forces [N] that carry a load; each `solve` starts from the
    last forces.

    Args:
        start: forces (f, 3) [N] on the object from which the first call starts; they press at every
            contact, in the frame of all later vectors.
        effort: largest torque (j,) [N m] of each of the j joints of the URDF.
        most: largest normal force [N] of each finger.
    """

    def __init__(self, start: Float[Array, "f 3"], effort: Float[Array, " j"], most: float) -> None:
        self.forces = start
        self.start = start
        self.effort = effort
        self.most = most

    def solve(
        self,
        contacts: Balance,
        normals: Float[Array, "f 3"],
        jacobian: Float[Array, "f 3 j"],
        load: Float[Array, "6"],
        friction: float,
        floor: Float[Array, "f"],
        reserve: Float[Array, "f"] | float = 0.0,
    ) -> Float[Array, "f 3"]:
        """Return the contact forces (f, 3) [N] on the object that exert `load` with the least sum
        of normal forces.

        All vectors are in one frame. The forces are within the friction cones, and joint torques
        near their limits cost extra. If no forces satisfy the constraints, the friction coefficient
        is raised to the least with which forces were found. The coefficient is also at least 1.25
        times the one that the internal part of `start` needs. Below it the forces would grow huge.

        Args:
            contacts: the grasp map.
            normals: outward unit normals of the contacts.
            jacobian: Jacobian [m/rad] of the fingertips with respect to all joints.
            load: wrench [N, N m] that the forces exert on the object, about the contacts' centroid.
            friction: coefficient of friction.
            floor: least normal force [N] of each finger.
            reserve: part of each normal force [N] that does not count for friction: the forces are
                within their cones even without this part.
        """
        floor = np.maximum(floor, reserve)
        count = len(normals)
        # rows that give each torque and each normal force as a share of its limit
        push = -(np.eye(count)[:, :, None] * normals / self.most).reshape(count, -1)
        torque = jacobian.reshape(3 * count, -1).T / self.effort[:, None]
        limits = np.concatenate([torque, push])
        carried = float(np.linalg.norm(load[:3]))
        gap = BARRIER.gap * (carried + float(floor.sum()))
        barrier = _Barrier(contacts, normals, limits, load, gap, reserve)
        # the load may have grown: internal forces are added
        growth = np.concatenate([[0.0], BARRIER.growth * 2.0 ** np.arange(BARRIER.growths)])
        internal = barrier.place(self.start, 0.0)
        tried = barrier.place(self.forces) + growth[:, None] * internal  # (g, k)
        ratios = friction_ratios(contacts.inner(self.start), normals)
        needed = BARRIER.margin * float(ratios.max())
        friction = max(friction, needed) if math.isfinite(needed) else friction
        # multiples of a step that is safe for every self-concordant function
        strides = 2.0 ** np.arange(BARRIER.strides)
        with np.errstate(invalid="ignore", divide="ignore"):  # of logarithms outside the cones
            z = barrier.choose(tried, friction, floor)
            # no cone contains a finger that does not press
            steps = BARRIER.steps if math.isfinite(barrier.squared) else 0
            for _ in range(steps):
                step, decrement = barrier.newton(z)
                trial = z + np.minimum(strides / (1 + decrement), 1.0)[:, None] * step
                value = barrier.value(trial)
                best = int(value.argmin())
                if not math.isfinite(value[best]):
                    break
                z = trial[best]
                if decrement < BARRIER.solved:
                    break
        self.forces = barrier.forces(z)
        return self.forces

    def share(
        self,
        forces: Float[Array, "f 3"],
        normals: Float[Array, "f 3"],
        jacobian: Float[Array, "f 3 j"],
    ) -> float:
        """Return the largest ratio of a joint torque or a normal force to its limit, for given
        `forces` [N]. The limits are `effort` and `most`.

        `normals` are outward unit vectors, and `jacobian` [m/rad] is that of the fingertips by all
        joints.
        """
        torque = np.abs(np.einsum("nij,ni->j", jacobian, forces)) / self.effort
        push = -(forces * normals).sum(-1)
        return max(float(torque.max()), float(push.max()) / self.most)


class _Barrier:
    """The objective that the solver minimises, as a function of the k coordinates z [N] of the
    internal forces.
    """

    def __init__(
        self,
        contacts: Balance,
        normals: Float[Array, "f 3"],
        limits: Float[Array, "l n"],
        load: Float[Array, "6"],
        gap: float,
        reserve: Float[Array, "f"] | float,
    ) -> None:
        self.count = len(normals)
        self.gap = gap
        self.reserve = reserve
        self.basis = contacts.free
        self.carried = contacts.inverse @ load
        self.rows = self.basis.reshape(self.count, 3, -1)
        self.spread = np.einsum("nik,nil->nkl", self.rows, self.rows)
        self.tau = limits @ self.basis
        self.tau_0 = limits @ self.carried
        self.push = -np.einsum("ni,nik->nk", normals, self.rows)
        self.push_0 = -(normals * self.carried.reshape(self.count, 3)).sum(-1)

    def place(self, forces: Float[Array, "f 3"], share: float = 1.0) -> Float[Array, " k"]:
        """Return z, the coordinates [N] of given `forces` [N] in the basis of the internal forces.

        Before that, `share` times the forces that carry the load is subtracted from the given
        forces.
        """
        return self.basis.T @ (forces.ravel() - share * self.carried)

    def forces(self, z: Float[Array, "*g k"]) -> Float[Array, "*g f 3"]:
        """Return the fingertip forces [N] at coordinates z; they carry the load."""
        return (self.carried + z @ self.basis.T).reshape(*z.shape[:-1], self.count, 3)

    def choose(
        self, tried: Float[Array, "g k"], friction: float, floor: Float[Array, "f"]
    ) -> Float[Array, " k"]:
        """Return the best of g coordinates z; if none is feasible, raise the friction coefficient
        and lower floors and reserves.
        """
        push = tried @ self.push.T + self.push_0
        forces = self.forces(tried)
        across = np.sqrt(np.maximum((forces**2).sum(-1) - push**2, 0.0))
        above = (push > floor).all(-1)  # (g,)
        self.floor = floor
        if not above.any():
            # only the row of the largest internal forces is left
            above = np.arange(len(tried)) == len(tried) - 1
            self.floor = np.maximum(np.minimum(floor, BARRIER.lower * push[-1]), 0.0)
        self.reserve = np.minimum(self.reserve, self.floor)
        left = push - self.reserve
        ratios = np.where(left > 0, across / np.maximum(left, BARRIER.least), np.inf)
        ratio = np.where(above, ratios.max(-1), np.inf)
        least = float(ratio.min())
        if least >= friction:
            friction = max(friction, BARRIER.raised * least)
        self.squared = friction**2
        value = self.value(tried)
        best = int(value.argmin())
        return tried[best if math.isfinite(value[best]) else int(ratio.argmin())]

    def value(self, z: Float[Array, "g k"]) -> Float[Array, " g"]:
        """Return the objective [N] at g coordinates z: infinite outside the friction cones."""
        n = z @ self.push.T + self.push_0
        t = z @ self.tau.T + self.tau_0
        lengths = (self.forces(z) ** 2).sum(-1)
        cone = self.squared * (n - self.reserve) ** 2 + n * n - lengths
        inside = ((cone > 0) & (n > self.floor)).all(-1)
        logs = np.log(cone).sum(-1) + np.log(n - self.floor).sum(-1)
        over = np.maximum(np.abs(t) - BARRIER.knee, 0.0)
        penalty = BARRIER.penalty * (over**2).sum(-1)
        return np.where(inside, n.sum(-1) + penalty - self.gap * logs, np.inf)

    def newton(self, z: Float[Array, " k"]) -> tuple[Float[Array, " k"], float]:
        """Return Newton's step (k,) at coordinates z, and the Newton decrement, which measures the
        distance from the optimum.

        Both are 0 where the Hessian is singular.
        """
        gap = self.gap
        push = self.push
        n = push @ z + self.push_0
        t = self.tau @ z + self.tau_0
        force = self.forces(z)
        left = n - self.reserve
        cone = self.squared * left * left + n * n - (force * force).sum(-1)
        # half of the gradient of each cone: (f, k)
        moved = np.einsum("ni,nik->nk", force, self.rows)
        half = (self.squared * left + n)[:, None] * push - moved
        above = n - self.floor
        # of the penalty
        over = np.sign(t) * np.maximum(np.abs(t) - BARRIER.knee, 0.0)
        penalty = 2 * BARRIER.penalty
        barrier = gap * ((2 / cone) @ half + (1 / above) @ push)
        gradient = push.sum(0) + penalty * over @ self.tau - barrier  # (k,)
        # (k, k): of the penalty and the floors, of the cones' gradients, of their curvature
        hessian = (self.tau.T * (penalty * (over != 0))) @ self.tau
        hessian = hessian + gap * ((push.T / above**2) @ push)
        bent = 2 * (1 + self.squared) * (push.T / cone) @ push
        hessian += gap * ((half.T * (4 / cone**2)) @ half - bent)
        hessian += gap * np.einsum("n,nkl->kl", 2 / cone, self.spread)
        try:
            step = -np.linalg.solve(hessian + BARRIER.ridge * np.eye(len(z)), gradient)
        except np.linalg.LinAlgError:
            # on the border of a cone one term outweighs all others by more than the digits
            return np.zeros_like(z), 0.0
        return step, math.sqrt(max(-float(gradient @ step), 0.0) / gap)
