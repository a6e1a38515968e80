"""A proven lower bound of the probability of closure, without sampling; in the spirit of PONG (arXiv 2309.16930).

Three contacts not on a line are closed if and only if internal forces along the edges of their triangle, g_ij from i
towards j and from j towards i alike, give each contact a force f_i = sum_j g_ij u_ij strictly inside its friction
cone: such forces balance wherever the contacts are, and all forces that balance are of this kind.

Fix g. A contact that moves by t_i along its planned normal n_i changes f_i by g (t_j n_j - t_i n_i) over the length of
the planned edge, for each edge, and the forces still balance. While |t_i| <= r_i for all i, f_i turns by at most an
angle eta_i, and it lies inside its cone of half angle theta whenever the slope w_i is within theta - eta_i of -f_i, a
round cone C_i of slopes. The slope is linear in t between the rungs of `plan/lines`, and C_i is convex: it is in C_i on
a stretch of the line if it is at both ends and at the rungs between. So closure follows from, for each i,

    d_i > 0 at t = r_i,    d_i <= 0 at t = -r_i,    w_i in C_i at both and at the rungs between,

and its probability is at least 1 minus the sum of the probabilities that each of these fails (Boole), whatever g and r
are: the greatest over some is taken. The first two are half spaces of a Gaussian. For the last, w = m + L v with v
of a standard normal: along a unit vector u the cone is left at v = u / q(u), where q, the gauge of a convex
set, is convex and homogeneous. On a spherical triangle it is at most its greatest value at the corners over the
distance of the corners' plane from the centre. With the share of each triangle in the sphere and the tail of the
chi distribution with three degrees of freedom the sum over a triangulated sphere bounds the probability of leaving.
"""

import functools
import itertools
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.frames import MIN_HEIGHT_RATIO
from torchgrasp.linalg import unit
from torchgrasp.plan.surface_samples import STEPS, SurfaceSamples, refinement

REACHES = (4, 5, 6, 7, 8)
"""Bounds r of the contacts' motion that are tried: steps of the finer ladder to either side of the contact."""

SOUGHT = 2
"""Which of them is assumed while the internal forces are sought."""

SEARCH, PROOF = 1, 3
"""Halvings of the octahedron's edges for the sphere on which forces are sought, and for that of the bound."""

ROUNDS = 3
"""Refinements of the internal forces, each about the best so far and half as wide as the last."""

AT_ONCE = 64
"""Triples that are bounded at a time."""


def closure_bound(lines: SurfaceSamples, friction: float) -> Float[Tensor, "b"]:
    """Return a lower bound of the probability that fingers close on surfaces drawn along their lines, from 0 to 1.

    Args:
        lines: of the triples.
        friction: of the round cones.
    """
    grid = torch.tensor(list(itertools.product((-2.0, -1.0, 0.0, 1.0, 2.0), repeat=3))).to(lines.points)
    steps = torch.unique(unit(grid[grid.abs().sum(1) > 0]), dim=0)
    bounds = lines.points.new_zeros(len(lines))
    for rows in torch.arange(len(lines), device=bounds.device).split(AT_ONCE):
        part = lines[rows]
        spread = (part.root @ part.root).unflatten(-1, (3, -1, 4)).unflatten(1, (3, -1, 4)).diagonal(dim1=1, dim2=4)
        spread = spread.movedim(-1, 1)  # (b, line, rung, 4, rung, 4)
        some = [_Stretches(part, spread, reach) for reach in REACHES]
        forces = some[SOUGHT].bound(steps.expand(len(rows), -1, -1), friction, SEARCH)[1]
        for level in range(ROUNDS):
            around = unit(forces[:, None] + 0.4 * 0.5**level * steps)
            forces = some[SOUGHT].bound(torch.cat([forces[:, None], around], 1), friction, SEARCH)[1]
        proven = torch.stack([stretches.bound(forces[:, None], friction, PROOF)[0] for stretches in some])
        bounds[rows] = proven.amax(0).clamp(min=0.0)  # 0 bounds every probability
    return bounds


class _Stretches:
    """Three stretches of lines about the contacts, and what internal forces prove while the fingers stop on them."""

    def __init__(self, lines: SurfaceSamples, spread: Float[Tensor, "b 3 k 4 k 4"], reach: int) -> None:
        self.points, self.normals = lines.points, lines.normals
        weights = refinement().to(lines.points)
        ends = [len(STEPS) - 1 - reach, len(STEPS) - 1 + reach]
        rungs = [i for i in range(ends[0] + 1, ends[1]) if bool((weights[i] == 1).any())]
        stations = weights[[*ends, *rungs]]
        self.slope = stations @ lines.slope
        self.spread = torch.einsum("sk,bikmjn,sj->bismn", stations, spread[..., 1:, :, 1:], stations)
        self.motion = lines.steps[..., ends[0]]
        deviation = torch.einsum("sk,bikj,sj->bis", stations, spread[..., 0, :, 0], stations)[..., :2].sqrt()
        outside, inside = (lines.distance[..., ends] / deviation).unbind(-1)
        self.lost = (torch.special.ndtr(-outside) + torch.special.ndtr(inside)).sum(-1)
        self.across = unit(
            torch.linalg.cross(self.points[:, 1] - self.points[:, 0], self.points[:, 2] - self.points[:, 0])
        )

    def bound(
        self, forces: Float[Tensor, "b g 3"], friction: float, level: int
    ) -> tuple[Float[Tensor, "b"], Float[Tensor, "b 3"]]:
        """Return the greatest bound over internal forces along the edges 12, 23 and 31, and those forces."""
        sides = self.points.roll(-1, 1) - self.points
        after = forces / torch.linalg.vector_norm(sides, dim=-1)[:, None]  # force over length, of the edge after i
        before = after.roll(1, 2)
        push = after[..., None] * sides[:, None]
        force = push - push.roll(1, 2)  # (b, g, contact, 3)
        size = torch.linalg.vector_norm(force, dim=-1)
        direction = force / size[..., None]
        # The motion t_k n_k moves force i by moves[i, k] t_k n_k, of which a part is along it and a part across.
        moves = torch.diag_embed((after + before).abs())
        for i in range(3):
            moves[..., i, (i + 1) % 3], moves[..., i, (i + 2) % 3] = after[..., i].abs(), before[..., i].abs()
        cosine = direction @ self.normals[:, None].mT
        sine = (1 - cosine**2).clamp(min=0.0).sqrt()
        moves = moves * self.motion[:, None, None]
        along = size - (moves * cosine.abs()).sum(-1)
        turn = torch.atan2((moves * sine).sum(-1), along)
        lost = self.lost[:, None] + self._outside(direction, math.atan(friction) - turn, level)
        valid = (along > 0).all(-1) & self._spans()[:, None]
        best, at = torch.where(valid, 1 - lost, -torch.inf).max(1)
        return best, forces[torch.arange(len(forces), device=forces.device), at]

    def _outside(
        self, direction: Float[Tensor, "b g 3 3"], angle: Float[Tensor, "b g 3"], level: int
    ) -> Float[Tensor, "b g"]:
        """Return a bound of the probability that a slope is not within `angle` of minus its force at each station."""
        corners, faces, share, distance = (t.to(direction) if t.is_floating_point() else t for t in sphere(level))
        # In axes of the force and of the contacts' plane, so that the triangulated sphere turns with the object.
        first = self.across[:, None, None].expand_as(direction)
        axes = torch.stack([-direction, first, torch.linalg.cross(direction, first)], -2)  # (b, g, 3, axis, 3)
        square = angle.cos()[..., None] ** 2
        lost = torch.zeros_like(angle)
        for mean, spread in zip(self.slope.unbind(2), self.spread.unbind(2), strict=True):
            root, broken = torch.linalg.cholesky_ex(axes @ spread[:, None] @ axes.mT)
            away = root @ corners.T  # (b, g, contact, 3, corner)
            mean = (axes @ mean[:, None, :, :, None])[..., 0]
            # Left where the form x^2 - cos^2 |.|^2, positive inside, is zero: c q^2 + 2 b q + a = 0 with q = 1 / |v|.
            a = away[..., 0, :] ** 2 - square * (away**2).sum(-2)
            b = mean[..., :1] * away[..., 0, :] - square * (mean[..., None] * away).sum(-2)
            c = mean[..., :1] ** 2 - square * (mean**2).sum(-1, keepdim=True)
            inside = (angle > 0) & (broken == 0) & (mean[..., 0] > 0) & (c[..., 0] > 0)
            gauge = ((-b + (b * b - a * c).clamp(min=0.0).sqrt()) / c).clamp(min=1e-12)
            left = distance / gauge[..., faces].amax(-1)
            tail = torch.erfc(left / math.sqrt(2)) + math.sqrt(2 / math.pi) * left * (-left * left / 2).exp()
            lost = lost + torch.where(inside, (share * tail).sum(-1), torch.inf)
        return lost.sum(-1)

    def _spans(self) -> Bool[Tensor, "b"]:
        """Tell which triangles stay clear of a line: widths and sides change by at most twice the largest motion."""
        sides = self.points - self.points.roll(1, 1)
        longest = torch.linalg.vector_norm(sides, dim=-1).amax(-1)
        width = torch.linalg.vector_norm(torch.linalg.cross(sides[:, 0], sides[:, 1]), dim=-1) / longest
        most = 2 * self.motion.amax(-1)
        return width - most > 1.01 * MIN_HEIGHT_RATIO * (longest + most)


@functools.cache
def sphere(level: int) -> tuple[Float[Tensor, "v 3"], Tensor, Float[Tensor, "f"], Float[Tensor, "f"]]:
    """Return corners, triangles, each triangle's share of the sphere, and its plane's distance from the centre.

    An octahedron whose edges are halved `level` times, the corners on the unit sphere.

    >>> float(sphere(2)[2].sum())
    1.0
    """
    triangles = torch.tensor(
        [[[x, 0, 0], [0, y, 0], [0, 0, z]] for x, y, z in itertools.product((1.0, -1.0), repeat=3)]
    )
    triangles = triangles.double()
    for _ in range(level):
        middle = unit(triangles + triangles.roll(-1, 1))  # of the edge after each corner
        inner = torch.stack([triangles, middle, middle.roll(1, 1)], 2).flatten(0, 1)
        triangles = torch.cat([inner, middle])
    a, b, c = triangles.unbind(1)
    volume = (a * torch.linalg.cross(b, c)).sum(-1).abs()
    share = 2 * torch.atan2(volume, 1 + (a * b).sum(-1) + (b * c).sum(-1) + (c * a).sum(-1)) / (4 * math.pi)
    normal = unit(torch.linalg.cross(b - a, c - a))
    corners, faces = torch.unique(triangles.flatten(0, 1), dim=0, return_inverse=True)
    return corners, faces.reshape(-1, 3), share, (normal * a).sum(-1).abs()
