"""What Eq. (21) accepts: codes that the hand meets, and codes that it does not, as a search tells."""

import dataclasses

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from benchmarks.common import Row
from torchgrasp import Hand, list_objects, load_hand, load_mixture, load_object, plan_grasps
from torchgrasp.base import Batch
from torchgrasp.errors import Status
from torchgrasp.geometry.linalg import unit
from torchgrasp.geometry.optim import LeastSquares, Residuals, levenberg_marquardt
from torchgrasp.posture_model.encoding import encode_fingertips
from torchgrasp.posture_model.mixture import DEFAULT_ENERGY, PAPER_ENERGY, GraspMixture
from torchgrasp.posture_model.sample import HandSamples, can_close, sample_configurations

HANDS = ("allegro", "barrett")
"""Hands whose acceptance is measured."""
HELD_OUT_SEED = 977
"""Of the postures whose codes are accepted or spoilt: not the seed of a shipped model."""
SEARCHED, STARTS, STEPS = 300, 16, 60
"""Codes of each kind that are searched for, nearest postures to start from, and steps of each search."""
LENGTH, COSINE = 1e-3, 0.02
"""Units of a code's error [m and cosine]: a code is met where all errors are below one unit."""
DIFFERENCE = 1e-6
"""Step of the derivatives by differences [rad]."""


@dataclasses.dataclass(frozen=True)
class Touch(Batch):
    """Joints [rad] and two tilts of each contact direction, as tangents of angles."""

    joints: Float[Tensor, "b h"]
    tilt: Float[Tensor, "b 6"]


def bench_reach(n: int) -> list[Row]:
    """Ask Eq. (21) for n held-out codes and codes of planned grasps, spoilt ones, and what a search says of these."""
    return [row for name in HANDS for row in _bench_hand(name, n)]


def _bench_hand(name: str, n: int) -> list[Row]:
    """Return the rows of one hand."""
    hand, mixture = load_hand(name), load_mixture(name)
    held_out = sample_configurations(hand, n, HELD_OUT_SEED, sampling="grasping")
    rows = [_row(name, "codes of held-out postures whose tips have rolled", mixture, held_out.q, ">= 95 %", None)]
    rows.append(_row(name, "codes of planned executable grasps", mixture, planned_postures(hand).q, ">= 95 %", None))
    for what, q in spoilt_codes(held_out.q, HELD_OUT_SEED).items():
        met = search(hand, held_out, q[:SEARCHED])
        rows.append(_row(name, what, mixture, q, "<= 10 % of those that no posture has", met))
    return rows


def planned_postures(hand: Hand) -> HandSamples:
    """Return postures and codes of the executable grasps on the library's own objects."""
    joints, codes = [], []
    for thing in map(load_object, list_objects()):
        grasps = plan_grasps(thing.view, hand)
        good = grasps[grasps.status == Status.OK]
        joints.append(good.joints)
        codes.append(encode_fingertips(good.contacts.points.double(), good.contacts.normals.double()))
    return HandSamples(torch.cat(joints), torch.cat(codes), hand.joint_names)


def spoilt_codes(q: Float[Tensor, "n 6"], seed: int) -> dict[str, Float[Tensor, "n 6"]]:
    """Return codes made from others by shuffling, scaling and replacement, by name."""
    generator = torch.Generator().manual_seed(seed)
    order = [torch.randperm(len(q), generator=generator) for _ in range(4)]
    together, apart, against = q.clone(), q.clone(), q.clone()
    together[:, 3:] = q[order[0], 3:]
    apart[:, 3:] = torch.stack([q[order[k + 1], 3 + k] for k in range(3)], 1)
    cosines = apart[:, 3:]
    apart = apart[1 + 2 * cosines.prod(1) > cosines.square().sum(1)]  # three unit vectors have no others
    against[:, 3:] = -1.0
    scaled = {f"lengths x {k:g}": torch.cat([k * q[:, :3], q[:, 3:]], 1) for k in (0.3, 2.0)}
    names = "cosines of another posture", "each cosine of another posture", "three opposite normals"
    return dict(zip(names, (together, apart, against), strict=True)) | scaled


def search(hand: Hand, samples: HandSamples, q: Float[Tensor, "k 6"]) -> Bool[Tensor, "k"]:
    """Tell which codes some posture has that is free, inside its pads' cones, and can close.

    Levenberg-Marquardt starts from the postures of the nearest codes, so a refusal is no proof.
    """
    scale = torch.tensor([10 * LENGTH] * 3 + [10 * COSINE] * 3, dtype=torch.float64)
    tree = cKDTree((samples.q / scale).numpy())
    nearest = torch.from_numpy(tree.query((q / scale).numpy(), k=STARTS)[1]).flatten()
    wanted = q.repeat_interleave(STARTS, 0)
    start = Touch(samples.joints[nearest], wanted.new_zeros(len(wanted), 6))

    def evaluate(touch: Touch, rows: Int[Tensor, "a"]) -> Residuals:
        whole = torch.cat([touch.joints, touch.tilt], 1)
        steps = torch.cat([torch.zeros(1, whole.shape[1]).to(whole), DIFFERENCE * torch.eye(whole.shape[1]).to(whole)])
        moved = (whole[:, None] + steps).flatten(0, 1)
        values = residual(moved, wanted[rows].repeat_interleave(len(steps), 0)).unflatten(0, (len(whole), -1))
        return values[:, 0], ((values[:, 1:] - values[:, :1]) / DIFFERENCE).mT

    def residual(x: Float[Tensor, "b d"], code: Float[Tensor, "b 6"]) -> Float[Tensor, "b 9"]:
        points, normals, inside = touch_points(hand, x[:, : hand.dof], x[:, hand.dof :])
        error = (encode_fingertips(points, normals) - code) / (0.1 * scale)
        return torch.cat([error, 50 * inside.clamp(max=0)], 1)

    def integrate(touch: Touch, step: Float[Tensor, "a d"]) -> Touch:
        joints = (touch.joints + step[:, : hand.dof]).clamp(hand.lower, hand.upper)
        return Touch(joints, touch.tilt + step[:, hand.dof :])

    found, _ = levenberg_marquardt(LeastSquares(evaluate, integrate), start, STEPS)
    points, normals, inside = touch_points(hand, found.joints, found.tilt)
    error = ((encode_fingertips(points, normals) - wanted) / (0.1 * scale)).abs().amax(1)
    good = (error < 1) & (inside > -0.02).all(1) & (hand.self_clearance(found.joints) > 0) & can_close(points, normals)
    return good.unflatten(0, (-1, STARTS)).any(1)


def touch_points(hand: Hand, joints: Tensor, tilt: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return contact points, outward normals, and how far cosines are inside the cones."""
    points, axes = hand.fingertips(joints)
    beside = torch.zeros_like(axes)
    beside[..., 1] = 1.0  # it turns with no axis of the search: any fixed tangent plane serves
    first = torch.linalg.cross(axes, beside)
    second = torch.linalg.cross(axes, first)
    normals = unit(axes + tilt[:, 0::2, None] * first + tilt[:, 1::2, None] * second)
    inside = (normals * axes).sum(-1) - torch.cos(hand.tips.cone)
    return points + hand.tips.radius[:, None] * (normals - axes), normals, inside


def _row(
    name: str, what: str, mixture: GraspMixture, q: Float[Tensor, "n 6"], bar: str, met: Bool[Tensor, "k"] | None
) -> Row:
    """Return the shares that are accepted, and of searched codes those of codes that no posture has."""
    energy = mixture.energy(q)
    shares = {r: float((energy < r).double().mean()) for r in (PAPER_ENERGY, DEFAULT_ENERGY)}
    text = f"{shares[DEFAULT_ENERGY]:.1%} accepted, {shares[PAPER_ENERGY]:.1%} at the paper's {PAPER_ENERGY:g}"
    numbers = {"accepted": shares[DEFAULT_ENERGY], "paper": shares[PAPER_ENERGY]}
    good = shares[DEFAULT_ENERGY] >= 0.95
    if met is not None:
        unmet = energy[: len(met)][~met]
        false = float((unmet < DEFAULT_ENERGY).double().mean()) if len(unmet) else np.nan
        reached = float(met.double().mean())
        text += f"; a posture is found for {reached:.1%}; of the others {false:.1%} accepted"
        numbers |= {"reached": reached, "false": false}
        good = not false > 0.1
    return Row(f"{name}: {what}", bar, text, good, numbers)
