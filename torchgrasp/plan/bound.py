"""A proven lower bound of the probability of closure, without sampling; in the spirit of PONG (arXiv 2309.16930).

Three contacts not on a line are closed if and only if internal forces along the edges of their triangle, g_ij from i
towards j and from j towards i alike, give each contact a force f_i = sum_j g_ij u_ij strictly inside its friction
cone: such forces balance wherever the contacts are, and all forces that balance are of this kind.

Fix g. A contact that moves by t_i along its planned normal n_i changes f_i by g (t_j n_j - t_i n_i) over the length of
the planned edge, for each edge, and the forces still balance. While |t_i| <= r_i for all i, f_i turns by at most an
angle eta_i, and it lies inside its cone of half angle theta whenever the slope w_i + t_i h_i is within theta - eta_i of
-f_i, a round cone C_i of slopes. It is for all t_i if it is for both ends. So closure follows from, for each i,

    d_i <= r_i w_i.n_i      and      -d_i <= r_i w_i.n_i      and      w_i + r_i h_i in C_i, w_i - r_i h_i in C_i,

and its probability is at least 1 minus the sum of the probabilities that each of these fails (Boole), whatever g and r
are: the greatest over some is taken. The first two are half spaces of the Gaussian (d, w). For the last, w = m + L v
with v of a standard normal: along a unit vector u the two cones are left at v = u / q(u), where q, the gauge of a
convex set, is convex and homogeneous. On a spherical triangle it is at most its greatest value at the corners over the
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

REACHES = (1.3, 1.6, 2.0, 2.4, 2.8, 3.4, 4.5)
"""Bounds r of the contacts' motion that are tried, in standard deviations."""

SEARCH, PROOF = 1, 3
"""Halvings of the octahedron's edges for the sphere on which forces are sought, and for that of the bound."""

ROUNDS = 3
"""Refinements of the internal forces, each about the best so far and half as wide as the last."""

AT_ONCE = 64
"""Triples that are bounded at a time."""


def closure_bound(
    points: Float[Tensor, "b 3 3"],
    normals: Float[Tensor, "b 3 3"],
    bends: Float[Tensor, "b 3 3"],
    mean: Float[Tensor, "b 12"],
    covariance: Float[Tensor, "b 12 12"],
    friction: float,
) -> Float[Tensor, "b"]:
    """Return a lower bound of the probability that contacts on planes d + w.(p - x) = 0 are closed, from 0 to 1.

    Args:
        points: planned contacts x, normalised.
        normals: outward unit normals n along which the fingers come.
        bends: h, the change of w along n.
        mean: of (d, w) at each contact in turn.
        covariance: of the same.
        friction: of the round cones.
    """
    grid = torch.tensor(list(itertools.product((-2.0, -1.0, 0.0, 1.0, 2.0), repeat=3))).to(points)
    steps = torch.unique(unit(grid[grid.abs().sum(1) > 0]), dim=0)
    bounds = points.new_zeros(len(points))
    for rows in torch.arange(len(points), device=points.device).split(AT_ONCE):
        planes = _Planes(points[rows], normals[rows], bends[rows], mean[rows], covariance[rows])
        forces = planes.bound(steps.expand(len(rows), -1, -1), friction, REACHES[2], SEARCH)[1]
        for level in range(ROUNDS):
            around = unit(forces[:, None] + 0.4 * 0.5**level * steps)
            forces = planes.bound(torch.cat([forces[:, None], around], 1), friction, REACHES[2], SEARCH)[1]
        proven = torch.stack([planes.bound(forces[:, None], friction, reach, PROOF)[0] for reach in REACHES])
        bounds[rows] = proven.amax(0).clamp(min=0.0)  # 0 bounds every probability
    return bounds


class _Planes:
    """The Gaussian of a batch of triples, and what internal forces prove of it."""

    def __init__(self, points: Tensor, normals: Tensor, bends: Tensor, mean: Tensor, covariance: Tensor) -> None:
        self.points, self.normals, self.bends = points, normals, bends
        self.distance, self.slope = mean.unflatten(-1, (3, 4))[..., 0], mean.unflatten(-1, (3, 4))[..., 1:]
        blocks = covariance.unflatten(-1, (3, 4)).unflatten(1, (3, 4)).diagonal(dim1=1, dim2=3).movedim(-1, 1)
        self.doubt, self.shared, self.spread = blocks[..., 0, 0], blocks[..., 0, 1:], blocks[..., 1:, 1:]
        self.across = unit(torch.linalg.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]))

    def bound(
        self, forces: Float[Tensor, "b g 3"], friction: float, reach: float, level: int
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
        motion = reach * self.doubt.sqrt() / (self.slope * self.normals).sum(-1)
        moves = moves * motion[:, None, None]
        along = size - (moves * cosine.abs()).sum(-1)
        turn = torch.atan2((moves * sine).sum(-1), along)
        lost = self._beyond(motion)[:, None] + self._outside(direction, math.atan(friction) - turn, motion, level)
        valid = (along > 0).all(-1) & (self._spans(motion) & (motion > 0).all(-1))[:, None]
        best, at = torch.where(valid, 1 - lost, -torch.inf).max(1)
        return best, forces[torch.arange(len(forces), device=forces.device), at]

    def _beyond(self, motion: Float[Tensor, "b 3"]) -> Float[Tensor, "b"]:
        """Return a bound of the probability that a contact moves further than `motion`."""
        reserve = motion * (self.slope * self.normals).sum(-1)
        square = motion**2 * ((self.spread @ self.normals[..., None])[..., 0] * self.normals).sum(-1) + self.doubt
        twice = 2 * motion * (self.shared * self.normals).sum(-1)
        tails = [
            torch.special.ndtr(-(reserve - sign * self.distance) / (square - sign * twice).sqrt()) for sign in (1, -1)
        ]
        return (tails[0] + tails[1]).sum(-1)

    def _outside(
        self,
        direction: Float[Tensor, "b g 3 3"],
        angle: Float[Tensor, "b g 3"],
        motion: Float[Tensor, "b 3"],
        level: int,
    ) -> Float[Tensor, "b g"]:
        """Return a bound of the probability that a slope is not within `angle` of minus its force, moved either way."""
        corners, faces, share, distance = (t.to(direction) if t.is_floating_point() else t for t in sphere(level))
        # In axes of the force and of the contacts' plane, so that the triangulated sphere turns with the object.
        first = self.across[:, None, None].expand_as(direction)
        axes = torch.stack([-direction, first, torch.linalg.cross(direction, first)], -2)  # (b, g, 3, axis, 3)
        root, broken = torch.linalg.cholesky_ex(axes @ self.spread[:, None] @ axes.mT)
        away = root @ corners.T  # (b, g, contact, 3, corner)
        square = angle.cos()[..., None] ** 2
        gauge, inside = torch.full_like(away[..., 0, :], 1e-12), (angle > 0) & (broken == 0)
        for end in (-1.0, 1.0):
            mean = (axes @ (self.slope + end * motion[..., None] * self.bends)[:, None, :, :, None])[..., 0]
            # Left where the form x^2 - cos^2 |.|^2, positive inside, is zero: c q^2 + 2 b q + a = 0 with q = 1 / |v|.
            a = away[..., 0, :] ** 2 - square * (away**2).sum(-2)
            b = mean[..., :1] * away[..., 0, :] - square * (mean[..., None] * away).sum(-2)
            c = mean[..., :1] ** 2 - square * (mean**2).sum(-1, keepdim=True)
            inside = inside & (mean[..., 0] > 0) & (c[..., 0] > 0)
            gauge = torch.maximum(gauge, (-b + (b * b - a * c).clamp(min=0.0).sqrt()) / c)
        left = distance / gauge[..., faces].amax(-1)
        tail = torch.erfc(left / math.sqrt(2)) + math.sqrt(2 / math.pi) * left * (-left * left / 2).exp()
        return torch.where(inside, (share * tail).sum(-1), torch.inf).sum(-1)

    def _spans(self, motion: Float[Tensor, "b 3"]) -> Bool[Tensor, "b"]:
        """Tell which triangles stay clear of a line: widths and sides change by at most twice the largest motion."""
        sides = self.points - self.points.roll(1, 1)
        longest = torch.linalg.vector_norm(sides, dim=-1).amax(-1)
        width = torch.linalg.vector_norm(torch.linalg.cross(sides[:, 0], sides[:, 1]), dim=-1) / longest
        most = 2 * motion.amax(-1)
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
