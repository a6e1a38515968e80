"""The GPIS baseline: our own small planner with an objective of SpringGrasp's kind.

It is not SpringGrasp, and its weights are ours. From [1] it has a Gaussian process on values alone
with the thin-plate kernel, points told to be inside and outside, seven guesses of the wrist, 200
steps of AdamW, and the objective: at the equilibrium of springs from the fingertips to targets in
the object, forces lie in the friction cones; tips are on the surface where it is certain; links are
outside.

[1] Chen, Bohg and Liu, "SpringGrasp: Synthesizing Compliant, Dexterous Grasps under Shape
Uncertainty", RSS 2024.
"""

import dataclasses
import itertools
import time

import numpy as np
import torch
from messages import JOINTS, find_versions, print_answer, read_task
from run_torchgrasp import describe_grasp
from torch import Tensor

from torchgrasp import Hand, load_hand
from torchgrasp.geometry.frames import rigid, rotation_from_vector


@dataclasses.dataclass(frozen=True)
class GpisNumbers:
    """Settings; those of the first three are SpringGrasp's."""

    observed: int = 200
    inside: int = 50
    steps: int = 200
    """Observed and inner points of the Gaussian process, and steps of AdamW."""
    rate: float = 0.02
    """Learning rate; lengths are in units of `unit`."""
    unit: float = 0.05
    """Unit of translations [m]."""
    noise: float = 1e-3
    """Standard deviation [m] of the points of the view."""
    away: float = 1.5
    """Distance of outer points from the middle, over the greatest of the cloud."""
    depth: float = 0.01
    """Depth [m] of a target at the start."""
    palm: float = 0.07
    """Distance [m] of a guess's palm from the middle, beyond the cloud's radius along its axis."""
    bent: tuple[float, ...] = (0.0, 0.5, 0.5, 0.5)
    thumb: tuple[float, ...] = (1.2, 0.5, 0.5, 0.4)
    """Joints [rad] of a guess."""
    cone: float = 10.0
    surface: float = 200.0
    unsure: float = 20.0
    outside: float = 50.0
    targets: float = 20.0
    """Weights of the parts of the objective: of angles, of lengths [1/m]."""
    near: float = 0.005
    """Greatest distance [m] from the estimated surface of tips of a grasp that counts."""
    least: float = 1e-6
    """Least length [m] of a spring."""


NUMBERS = GpisNumbers()


class Surface:
    """A Gaussian process on signed distances [m], with the thin-plate kernel."""

    def __init__(self, points: Tensor, rng: np.random.Generator) -> None:
        self.middle = points.mean(0)
        seen = points[farthest(points, NUMBERS.observed)]
        weights = torch.tensor(rng.dirichlet(np.ones(4), NUMBERS.inside))
        rows = torch.tensor(rng.integers(len(seen), size=(NUMBERS.inside, 4)))
        inner = (weights[..., None] * seen[rows]).sum(1)
        corners = torch.tensor(list(itertools.product((-1.0, 1.0), repeat=3)), dtype=points.dtype)
        axes = torch.cat([torch.eye(3), -torch.eye(3)]).to(points)
        rays = torch.cat([corners / corners.norm(dim=1, keepdim=True), axes])  # 14
        reach = NUMBERS.away * (points - self.middle).norm(dim=1).max()
        outer = self.middle + reach * rays
        self.at = torch.cat([seen, inner, outer])
        value = torch.cdist(self.at, seen).amin(1)
        value[len(seen) : len(seen) + len(inner)] *= -1.0
        self.reach = torch.cdist(self.at, self.at).max()
        gram = self.kernel(self.at, self.at)
        noise = (NUMBERS.noise / self.reach) ** 2 * self.kernel(self.at[:1], self.at[:1])[0, 0]
        self.factor = torch.linalg.cholesky(gram + noise * torch.eye(len(gram)).to(gram))
        self.weights = torch.cholesky_solve(value[:, None], self.factor)[:, 0]

    def kernel(self, one: Tensor, two: Tensor) -> Tensor:
        """Return the covariances (n, m) of points (n, 3) and (m, 3) [m], without a scale."""
        square = (one[:, None] - two).square().sum(-1) / self.reach**2
        return 2 * (square + NUMBERS.least**2) ** 1.5 - 3 * square + 1

    def mean(self, points: Tensor) -> Tensor:
        """Return the mean distances (...) [m] of points (..., 3) [m]."""
        flat = self.kernel(points.reshape(-1, 3), self.at) @ self.weights
        return flat.reshape(points.shape[:-1])

    def spread(self, points: Tensor) -> Tensor:
        """Return the standard deviations (...) of points (..., 3) [m], over that far away."""
        across = self.kernel(points.reshape(-1, 3), self.at)
        known = (across * torch.cholesky_solve(across.T, self.factor).T).sum(1)
        return (1 - known).clamp_min(NUMBERS.least).sqrt().reshape(points.shape[:-1])


def farthest(points: Tensor, count: int) -> list[int]:
    """Return the rows of points far from each other, one after another."""
    rows = [0]
    distance = torch.full((len(points),), torch.inf, dtype=points.dtype)
    while len(rows) < min(count, len(points)):
        distance = torch.minimum(distance, (points - points[rows[-1]]).norm(dim=1))
        rows.append(int(distance.argmax()))
    return rows


def guess_poses(hand: Hand, surface: Surface, points: Tensor) -> Tensor:
    """Return seven poses (7, 4, 4) [m] whose palm looks at the middle: from above, and around."""
    poses = []
    away = [torch.tensor([0.0, 0.0, 1.0], dtype=points.dtype)]
    for angle in torch.arange(6) * (torch.pi / 3):
        away.append(torch.tensor([float(angle.cos()), float(angle.sin()), 0.0]).to(points))
    for ray in away:
        forward = -ray
        up = torch.tensor([0.0, 0.0, 1.0] if abs(float(ray[2])) < 0.5 else [1.0, 0.0, 0.0])
        side = torch.linalg.cross(up.to(points), forward)
        # x out of the palm, z along the fingers, level at the sides
        turn = torch.stack([forward, torch.linalg.cross(side, forward), side], 1)
        reach = ((points - surface.middle) @ ray).max() + NUMBERS.palm
        poses.append(rigid(turn, surface.middle + reach * ray))
    return torch.stack(poses)


def settle(tips: Tensor, targets: Tensor, stiffness: Tensor) -> Tensor:
    """Return where springs to targets (g, f, 3) [m] carry the tips (g, f, 3) [m] with the object."""
    share = (stiffness / stiffness.sum(1, keepdim=True))[..., None]
    here = (share * tips).sum(1, keepdim=True)
    there = (share * targets).sum(1, keepdim=True)
    across = (share * (targets - there)).transpose(1, 2) @ (tips - here)
    # one turn, small: the torque of the springs over the inertia of the tips
    skewed = across - across.transpose(1, 2)
    torque = torch.stack([skewed[:, 2, 1], skewed[:, 0, 2], skewed[:, 1, 0]], -1)
    inertia = (share * (tips - here).square()).sum((1, 2))
    turn = rotation_from_vector(torque / inertia[:, None].clamp_min(NUMBERS.least))
    return there + (tips - here) @ turn.transpose(1, 2)


def search(hand: Hand, surface: Surface, begin: Tensor, friction: float) -> tuple[Tensor, ...]:
    """Return joints (7, 16), poses (7, 4, 4), and a mask of those that keep their own constraints."""
    g = len(begin)
    f = len(hand.tips)
    start = torch.tensor([*NUMBERS.bent * 3, *NUMBERS.thumb], dtype=begin.dtype)
    start = start.clamp(hand.lower, hand.upper)
    joints = start.repeat(g, 1).requires_grad_()
    moves = torch.zeros(g, 6, dtype=begin.dtype, requires_grad=True)
    depth = torch.full((g, f), NUMBERS.depth / NUMBERS.unit, dtype=begin.dtype, requires_grad=True)
    spring = torch.zeros(g, f, dtype=begin.dtype, requires_grad=True)
    optimiser = torch.optim.AdamW([joints, moves, depth, spring], lr=NUMBERS.rate)
    radius = hand.tip_radius.to(begin)
    spheres = hand.collision_spheres
    links = ~spheres.touching
    for step in range(NUMBERS.steps + 1):
        turn = rotation_from_vector(moves[:, 3:])
        pose = begin @ rigid(turn, NUMBERS.unit * moves[:, :3])
        rotation = pose[:, None, :3, :3]
        place = pose[:, None, :3, 3]
        kept = joints.clamp(hand.lower, hand.upper)
        centres = (rotation @ hand.tip_centres(kept)[..., None])[..., 0] + place
        balls = (rotation @ hand.sphere_centres(kept)[:, links, :, None])[..., 0] + place
        height = surface.mean(centres)
        (slope,) = torch.autograd.grad(height.sum(), centres, create_graph=True)
        normals = slope / slope.norm(dim=-1, keepdim=True)
        tips = centres - radius[:, None] * normals
        targets = tips - NUMBERS.unit * depth.clamp_min(0)[..., None] * normals
        stiffness = spring.exp()
        force = targets - settle(tips, targets, stiffness)
        length = force.norm(dim=-1).clamp_min(NUMBERS.least)
        inward = -(force * normals).sum(-1) / length
        lack = (1 / (1 + friction**2) ** 0.5 - inward).clamp_min(0)
        off = height - radius
        bulge = (spheres.radius[links].to(begin) - surface.mean(balls)).clamp_min(0)
        shallow = (NUMBERS.depth - NUMBERS.unit * depth).clamp_min(0)
        cost = NUMBERS.cone * lack.sum(1) + NUMBERS.surface * off.abs().sum(1)
        cost = cost + NUMBERS.unsure * surface.spread(tips).sum(1)
        cost = cost + NUMBERS.outside * bulge.sum(1) + NUMBERS.targets * shallow.sum(1)
        if step < NUMBERS.steps:
            optimiser.zero_grad()
            cost.sum().backward()
            optimiser.step()
    good = (lack <= 0).all(1) & (off.abs() <= NUMBERS.near).all(1)
    return kept.detach(), pose.detach(), good


def main() -> None:
    """Plan from one view, and print the grasps that keep their own constraints."""
    torch.set_num_threads(1)
    task = read_task()
    hand = load_hand("allegro", "four")
    points = torch.tensor(np.loadtxt(task["view"]))
    began = time.process_time()
    surface = Surface(points, np.random.default_rng(task["seed"]))
    begin = guess_poses(hand, surface, points)
    joints, poses, good = search(hand, surface, begin, task["friction"])
    seconds = time.process_time() - began
    rows = torch.nonzero(good)[:, 0].tolist()
    print_answer(
        fingers="four",
        sees="view",
        settings=f"{NUMBERS.steps} steps of AdamW on {len(begin)} guesses",
        versions=find_versions("torch"),
        tried=len(begin),
        seconds=seconds,
        joint_names=JOINTS,
        grasps=[describe_grasp(joints[row].tolist(), poses[row]) for row in rows],
    )


if __name__ == "__main__":
    main()
