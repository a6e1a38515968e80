"""The min-weight baseline: our own small planner on the problem that FRoGGeR's paper states.

It is not FRoGGeR. From [1] it has the problem and the settings of the published example: four
fingertips on the true surface, the least weight of a balance of the contacts' wrenches as objective
and constraint, clearances, joint limits, SLSQP from one start at a time, and starts whose palm
faces the object's box. Kinematics, distances and code are ours. A start ends at the first point where
all constraints hold; FRoGGeR goes on until SLSQP converges, which takes longer.

[1] Li, Culbertson, Burdick and Ames, "FRoGGeR: Fast Robust Grasp Generation via the Min-Weight
Metric", IROS 2023.
"""

import dataclasses
import time
from typing import NamedTuple

import numpy as np
import torch
import trimesh
from messages import JOINTS, find_versions, print_answer, read_task
from run_torchgrasp import describe_grasp
from scipy.ndimage import map_coordinates, spline_filter
from scipy.optimize import brentq, least_squares, minimize
from scipy.stats import vonmises_fisher

from torchgrasp import Contacts, ContactSpec, Hand, certify, load_hand
from torchgrasp.geometry.frames import rigid, rotation_from_vector
from torchgrasp.geometry.signed_distance import field_from_surface
from torchgrasp.ik.configuration import Configuration, SpatialJacobian


@dataclasses.dataclass(frozen=True)
class MinWeightNumbers:
    """Settings: those of FRoGGeR's published example where it has them."""

    friction: float = 0.7
    edges: int = 4
    """Coefficient of friction, and edges of a friction cone."""
    least: float = 0.3
    """Least weight over that of equal weights."""
    clearance: float = 0.001
    """Clearance [m] of links from the object and from each other."""
    on_surface: float = 0.001
    lacking: float = 0.001
    unclosed: float = 1e-5
    """Largest errors [m], [m] and of the least weight of a solution that counts."""
    evaluations: int = 1000
    seconds: float = 60.0
    """Most evaluations and seconds of one start."""
    precision: float = 1e-6
    """Change of objective and unknowns at which SLSQP ends."""
    away: float = 0.05
    """Distance [m] of a start's palm from the object's box."""
    ahead: float = 0.08
    beside: tuple[float, ...] = (0.04, 0.0, -0.04, 0.02)
    """Places [m] of a start's fingertips in front of the palm, and along its y axis."""
    concentration: float = 20.0
    """Concentration of the von Mises distribution of a start's palm axis."""
    palm: tuple[float, ...] = (0.0, 0.02, 0.0)
    """The palm's middle [m] in the hand's root frame."""
    fingers: tuple[float, ...] = (0.0, 0.5, 0.5, 0.5)
    thumb: tuple[float, ...] = (1.2, 0.5, 0.5, 0.4)
    """Joints [rad] from which a start's posture is sought."""
    unit: float = 0.01
    """Unit of lengths [m], in which unknowns and constraints are of order one (ours)."""
    spacing: float = 0.003
    """Spacing [m] of the grid of distances from the mesh (ours)."""
    reach: int = 30
    """Most evaluations of a start's posture (ours)."""
    step: float = 0.001
    """Step [m] of difference quotients of distances (ours)."""
    pairs: int = 12
    """Number of least separations of links that are constrained (ours: FRoGGeR has all)."""


NUMBERS = MinWeightNumbers()


class Surface:
    """The signed distance [m] from a mesh: a cubic spline on a grid, so that it bends smoothly."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        vertices = torch.tensor(mesh.vertices, dtype=torch.float64)
        field = field_from_surface(vertices, torch.tensor(mesh.faces), NUMBERS.spacing)
        self.origin = field.origin.numpy()
        self.values = field.values.numpy()
        self.smooth = spline_filter(self.values, order=3)

    def distance(self, points: np.ndarray, order: int = 3) -> np.ndarray:
        """Return the distances (n,) [m] of points (n, 3) [m]; `order` 1 is faster."""
        last = self.origin + NUMBERS.spacing * (np.array(self.values.shape) - 1)
        inside = points.clip(self.origin, last)
        beyond = np.linalg.norm(points - inside, axis=1)
        at = ((inside - self.origin) / NUMBERS.spacing).T
        values = self.smooth if order > 1 else self.values
        found = map_coordinates(values, at, order=order, mode="nearest", prefilter=False)
        return found + beyond

    def gradient(self, points: np.ndarray, order: int = 3) -> np.ndarray:
        """Return the derivatives (n, 3) of the distances of points (n, 3) [m]."""
        steps = NUMBERS.step * np.concatenate([np.eye(3), -np.eye(3)])
        around = self.distance((points[:, None] + steps).reshape(-1, 3), order).reshape(-1, 6)
        return (around[:, :3] - around[:, 3:]) / (2 * NUMBERS.step)

    def hessian(self, points: np.ndarray) -> np.ndarray:
        """Return the second derivatives (n, 3, 3) [1/m] of the distances of points (n, 3) [m]."""
        steps = NUMBERS.step * np.concatenate([np.eye(3), -np.eye(3)])
        slopes = self.gradient((points[:, None] + steps).reshape(-1, 3)).reshape(-1, 6, 3)
        found = (slopes[:, :3] - slopes[:, 3:]) / (2 * NUMBERS.step)
        return (found + found.transpose(0, 2, 1)) / 2


class Values(NamedTuple):
    """The values of unknowns, each with its derivative: least weight, equations, inequalities >= 0."""

    weight: float
    by_weight: np.ndarray
    off: np.ndarray
    by_off: np.ndarray
    room: np.ndarray
    by_room: np.ndarray

    @property
    def feasible(self) -> bool:
        """Whether all constraints hold within the published tolerances."""
        on = np.abs(self.off).max() * NUMBERS.unit <= NUMBERS.on_surface
        clear = self.room.min() * NUMBERS.unit >= -NUMBERS.lacking
        return bool(on and clear and self.weight >= NUMBERS.least - NUMBERS.unclosed)


class Ended(Exception):
    """Ends a start: a grasp is found, or time or evaluations are spent."""


class Search:
    """A search from one configuration.

    Unknowns are a translation (in `unit`) and a rotation vector of the hand in the axes of its
    beginning, then its joints [rad].
    """

    def __init__(self, hand: Hand, surface: Surface, begin: Configuration) -> None:
        self.hand = hand
        self.surface = surface
        self.begin = begin
        self.known: dict[bytes, Values] = {}
        self.evaluations = 0
        self.found: Configuration | None = None
        self.until = time.process_time() + NUMBERS.seconds

    def run(self) -> Configuration | None:
        """Return the first grasp for which all constraints hold; None if SLSQP meets none."""
        limits = list(zip(self.hand.lower.tolist(), self.hand.upper.tolist(), strict=True))
        start = np.concatenate([np.zeros(6), self.begin.joints[0].numpy()])
        equal = {"type": "eq", "fun": self.off, "jac": self.by_off}
        more = {"type": "ineq", "fun": self.room, "jac": self.by_room}
        try:
            minimize(
                lambda x: -self.at(x).weight,
                start,
                jac=lambda x: -self.at(x).by_weight,
                method="SLSQP",
                bounds=[(None, None)] * 6 + limits,
                constraints=[equal, more],
                options={"maxiter": NUMBERS.evaluations, "ftol": NUMBERS.precision},
            )
        except Ended:
            pass
        return self.found

    def off(self, x: np.ndarray) -> np.ndarray:
        """Return the equations: the tips' distances from the surface."""
        return self.at(x).off

    def by_off(self, x: np.ndarray) -> np.ndarray:
        """Return the derivatives of the equations."""
        return self.at(x).by_off

    def room(self, x: np.ndarray) -> np.ndarray:
        """Return the inequalities (>= 0): clearances, then the least weight."""
        return np.append(self.at(x).room, self.at(x).weight - NUMBERS.least)

    def by_room(self, x: np.ndarray) -> np.ndarray:
        """Return the derivatives of the inequalities."""
        return np.vstack([self.at(x).by_room, self.at(x).by_weight])

    def at(self, x: np.ndarray) -> Values:
        """Return the values of unknowns, computed once."""
        key = x.tobytes()
        if key not in self.known:
            if self.evaluations >= NUMBERS.evaluations or time.process_time() > self.until:
                raise Ended
            found = self.evaluate(x)
            self.known = {key: found}
            self.evaluations += 1
            if found.feasible:
                self.found = self.configuration(x)
                raise Ended
        return self.known[key]

    def configuration(self, x: np.ndarray) -> Configuration:
        """Return the configuration of unknowns."""
        moved = NUMBERS.unit * torch.tensor(x[:3])
        step = rigid(rotation_from_vector(torch.tensor(x[3:6])), moved)
        joints = torch.tensor(x[6:])[None].clamp(self.hand.lower, self.hand.upper)
        return Configuration(joints, self.begin.obj_from_hand @ step)

    def evaluate(self, x: np.ndarray) -> Values:
        """Return the values of unknowns with their derivatives."""
        spatial = SpatialJacobian.at(self.hand, self.configuration(x))
        by_hand = steps_by_unknowns(x)
        weight, by_weight, off, by_off = self._touch(spatial)
        room, by_room = self._clear(spatial)
        unit = NUMBERS.unit
        return Values(
            weight,
            by_weight @ by_hand,
            off / unit,
            by_off @ by_hand / unit,
            room / unit,
            by_room @ by_hand / unit,
        )

    def _touch(self, spatial: SpatialJacobian) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """Return least weight and the tips' distances from the surface [m], with derivatives."""
        tips = self.hand.tips
        centres = spatial.tips.permute(2, 1, 0)  # (1, f, 3)
        axes = torch.eye(3, dtype=torch.float64).repeat(len(tips), 1)  # (3 f, 3)
        moved = jacobian(
            spatial, centres[0].repeat_interleave(3, 0), axes, tips.index.repeat_interleave(3)
        )
        radius = tips.radius.numpy()
        at = centres[0].numpy()
        slope = self.surface.gradient(at)
        length = np.linalg.norm(slope, axis=1)
        normals = slope / length[:, None].clip(NUMBERS.step)
        flat = np.eye(3) - normals[:, :, None] * normals[:, None]
        turned = flat @ self.surface.hessian(at) / length[:, None, None]  # normals by centres
        off = self.surface.distance(at) - radius
        by_centre = moved.reshape(len(tips), 3, -1)
        by_off = (slope[:, None] @ by_centre)[:, 0]
        points = torch.tensor(at - radius[:, None] * normals, requires_grad=True)
        directions = torch.tensor(normals, requires_grad=True)
        spec = ContactSpec(
            NUMBERS.friction, NUMBERS.edges, friction_margin=1.0, fingertips=len(tips)
        )
        margin = certify(Contacts(points[None], directions[None]), spec).margin
        scale = len(tips) * NUMBERS.edges
        by_point, by_normal = torch.autograd.grad(margin.sum(), [points, directions])
        by_normal = by_normal.numpy() - radius[:, None] * by_point.numpy()
        pull = by_point.numpy() + (by_normal[:, None] @ turned)[:, 0]
        by_weight = scale * np.einsum("fi,fid->d", pull, by_centre)
        return scale * margin.item(), by_weight, off, by_off

    def _clear(self, spatial: SpatialJacobian) -> tuple[np.ndarray, np.ndarray]:
        """Return the clearances [m] that links have beyond what is asked, with derivatives."""
        spheres = self.hand.collision_spheres
        centres = spatial.sphere_centres[0]
        clear = self.surface.distance(centres.numpy(), 1) - spheres.radius.numpy()
        clear = np.where(spheres.touching.numpy(), np.inf, clear)
        links = spheres.link_index.numpy()
        least = [
            rows[clear[rows].argmin()]
            for rows in (np.flatnonzero(links == k) for k in np.unique(links))
        ]
        near = torch.tensor([row for row in least if np.isfinite(clear[row])])
        away = torch.from_numpy(self.surface.gradient(centres[near].numpy(), 1))
        by_clear = jacobian(spatial, centres[near], away, spheres.link_index[near])
        pairs = self.hand.self_collision
        apart, number, wrench = pairs.pushes(spatial.obj_from_link, 2 * NUMBERS.clearance)
        between, index = apart[:, 0].topk(NUMBERS.pairs, largest=False)
        moves = self.hand.motion.moves
        first, second = moves[pairs.link[pairs.pairs[index]]].to(wrench).unbind(1)
        forces = wrench.T[number[index, 0]]
        by_between = spatial.jacobian(forces[None], second - first)[0].numpy()
        room = np.concatenate([clear[near.numpy()], between.numpy()]) - NUMBERS.clearance
        return room, np.concatenate([by_clear, by_between])


def jacobian(
    spatial: SpatialJacobian, points: torch.Tensor, directions: torch.Tensor, links: torch.Tensor
) -> np.ndarray:
    """Return the derivatives (k, d) of k points [m] on links along k directions."""
    wrench = torch.cat([directions, torch.linalg.cross(points, directions)], -1)
    moves = spatial.hand.motion.moves[links].to(wrench)
    return spatial.jacobian(wrench[None], moves)[0].numpy()


def steps_by_unknowns(x: np.ndarray) -> np.ndarray:
    """Return the derivative (d, d) of steps in the hand's present axes by the unknowns."""
    steps = np.eye(len(x))
    vector = x[3:6]
    angle = float(np.linalg.norm(vector))
    cross = np.cross(vector, np.eye(3)).T  # cross @ v is vector x v
    first = 0.5
    second = 1 / 6
    if angle > NUMBERS.step:
        first = (1 - np.cos(angle)) / angle**2
        second = (angle - np.sin(angle)) / angle**3
    turned = rotation_from_vector(torch.tensor(vector)).numpy()
    steps[:3, :3] = NUMBERS.unit * turned.T
    steps[3:6, 3:6] = np.eye(3) - first * cross + second * cross @ cross
    return steps


class Sampler:
    """Starts whose palm faces the object's box, with fingertips on both sides of it."""

    def __init__(self, hand: Hand, mesh: trimesh.Trimesh, seed: int) -> None:
        self.hand = hand
        self.rng = np.random.default_rng(seed)
        to_box, self.lengths = trimesh.bounds.oriented_bounds(mesh)
        self.axes = np.linalg.inv(to_box)[:3, :3]  # columns: the axes of the oriented box
        self.middle = mesh.bounds.mean(0)
        self.half = np.ptp(mesh.bounds, axis=0) / 2
        self.centre = np.asarray(mesh.center_mass)

    def draw(self) -> Configuration:
        """Return a start."""
        first = self.rng.choice(3, p=self.lengths / self.lengths.sum())
        rest = [k for k in range(3) if k != first]
        second = self.rng.choice(rest, p=self.lengths[rest] / self.lengths[rest].sum())
        y = self.rng.choice([-1.0, 1.0]) * self.axes[:, first]
        x = self.rng.choice([-1.0, 1.0]) * self.axes[:, second]
        y = vonmises_fisher(y, NUMBERS.concentration).rvs(1, random_state=self.rng)[0]
        x = x - (x @ y) * y
        x /= np.linalg.norm(x)
        turn = np.stack([x, y, np.cross(x, y)], 1)
        reach = brentq(lambda a: self._outside(self.centre - a * x) - NUMBERS.away, 0.0, 1.0)
        palm = self.centre - reach * x
        pose = rigid(torch.tensor(turn), torch.tensor(palm - turn @ np.array(NUMBERS.palm)))
        width = self.lengths[np.abs(self.axes.T @ turn[:, 2]).argmax()]
        return Configuration(torch.tensor(self._reach(width))[None], pose[None])

    def _outside(self, point: np.ndarray) -> float:
        """Return the signed distance [m] of a point from the upright box of the object."""
        beyond = np.abs(point - self.middle) - self.half
        return float(np.linalg.norm(beyond.clip(0)) + min(beyond.max(), 0.0))

    def _reach(self, width: float) -> np.ndarray:
        """Return joints [rad] that put the fingers at half a `width` [m] on either side."""
        side = np.array([width, width, width, -width]) / 2
        ahead = np.full(4, NUMBERS.ahead)
        wanted = np.stack([ahead, np.array(NUMBERS.beside), side], 1) + np.array(NUMBERS.palm)
        lower = self.hand.lower.numpy()
        upper = self.hand.upper.numpy()
        start = np.array([*NUMBERS.fingers * 3, *NUMBERS.thumb]).clip(lower, upper)

        def miss(joints: np.ndarray) -> np.ndarray:
            return (self.hand.tip_centres(torch.tensor(joints)).numpy() - wanted).ravel()

        def slope(joints: np.ndarray) -> np.ndarray:
            at = torch.tensor(joints)
            found = self.hand.jacobian(at, self.hand.tip_centres(at))
            return found.numpy().reshape(-1, self.hand.dof)

        return least_squares(miss, start, slope, (lower, upper), max_nfev=NUMBERS.reach).x


def main() -> None:
    """Search until the time is spent, and print the grasps."""
    torch.set_num_threads(1)
    task = read_task()
    hand = load_hand("allegro", "four")
    mesh = trimesh.load_mesh(task["mesh"])
    began = time.process_time()
    surface = Surface(mesh)
    sampler = Sampler(hand, mesh, task["seed"])
    found = list[Configuration]()
    tried = 0
    evaluations = 0
    while time.process_time() - began < task["seconds"]:
        search = Search(hand, surface, sampler.draw())
        grasp = search.run()
        tried += 1
        evaluations += search.evaluations
        if grasp is not None:
            found.append(grasp)
    seconds = time.process_time() - began
    print_answer(
        fingers="four",
        sees="mesh",
        settings=f"SciPy's SLSQP, {evaluations / tried:.0f} evaluations a start",
        versions=find_versions("scipy", "torch"),
        tried=tried,
        seconds=seconds,
        joint_names=JOINTS,
        grasps=[describe_grasp(x.joints[0].tolist(), x.obj_from_hand[0]) for x in found],
    )


if __name__ == "__main__":
    main()
