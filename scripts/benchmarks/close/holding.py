"""Holding what one cannot know: the true mass, a friction that nobody told, a push, and what
statics say of it.

The best grasp of one view of each object is lifted with every holding and friction, and is pushed
or not. Static analysis at the contacts there are when the hand has pressed says whether its drives
could hold the object, and at the end what would suffice for the weight and a push from the worst
side.
"""

import dataclasses
import itertools
import math
import statistics
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from paper.tables6_7 import format_points
from paper.trials import Subject, TableSpec, subjects
from scipy.optimize import linprog
from torch import Tensor

from benchmarks.close.campaign import keep, plan_view, read_solid, run_all, table_spec
from benchmarks.close.household import HOUSEHOLD
from benchmarks.common import Options, Row, bench
from torchgrasp import close_hand
from torchgrasp.control.tactile import joint_jacobian
from torchgrasp.evaluation.intervals import contrast_over, count_by, format_share, share_over
from torchgrasp.evaluation.protocols import draw_push, seed_of
from torchgrasp.geometry.frames import apply, inverse
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import load_hand
from torchgrasp.values.closing import ClosureResult

FRICTIONS = (0.4, 0.7, 1.0)
"""Frictions that the hand does not know."""

HOLDINGS: dict[str, dict[str, Any]] = {
    "force, 4 N": {"holding": "force", "force": 4.0},
    "force, 6 N": {"holding": "force", "force": 6.0},
    "grip": {"holding": "grip", "force": None},
}
"""Changes of the trial by the name of the holding."""

PUSHES = (0.0, 2.5)
"""Forces [N] that push the lifted object."""

LEAST_HELD = 0.92
MOST_SPENT = 1.5
"""The project's bars: share held of what can be held, and force over what suffices."""

HOLD_TIME = 4.0
"""Time [s] after the lift: forces have fallen to what suffices."""


@bench("close/holding", objects=True)
def holding(o: Options) -> list[Row]:
    """Lift every object with every holding and friction."""
    spec = table_spec(o)
    rows = list[Row]()
    for hand in spec.hands:
        tasks = [(spec, subject, hand) for subject in subjects(spec)]
        lifts = [lift for found in run_all(hold_object, tasks, spec.workers) for lift in found]
        for push, name in itertools.product(PUSHES, HOLDINGS):
            some = [x for x in lifts if x["push"] == push]
            mine, base = (
                [x for x in some if x["holding"] == y] for y in (name, next(iter(HOLDINGS)))
            )
            rows.append(_row(f"{hand}, pushed" if push else hand, name, mine, base))
    return rows


def hold_object(spec: TableSpec, subject: Subject, hand: str) -> list[dict[str, Any]]:
    """Return the lifts of one object, kept or run."""
    path = spec.kept(
        "holding", f"{hand}_{subject.label}", HOLDINGS, FRICTIONS, PUSHES, HOLD_TIME
    ).with_suffix(".json")
    return keep(path, lambda: list(_lift(spec, subject, hand)))


def _lift(spec: TableSpec, subject: Subject, hand_name: str) -> Iterator[dict[str, Any]]:
    """Lift the best grasp of the first view."""
    hand = load_hand(hand_name)
    (mesh, parts, mass, view) = read_solid(subject)
    grasps = plan_view(spec, subject, hand_name, HOUSEHOLD.trial.friction)
    for friction, push in itertools.product(FRICTIONS, PUSHES) if grasps else ():
        seed = seed_of(spec.seed, subject.label, view, str(friction))
        force = draw_push(push, seed)
        for name, law in HOLDINGS.items():
            changes = law | {
                "mass": mass,
                "friction": friction,
                "hold_time": HOLD_TIME,
                "push": force,
            }
            done = close_hand(
                grasps[0],
                hand,
                mesh,
                dataclasses.replace(HOUSEHOLD.trial, **changes),
                seed,
                parts=parts,
            )
            told = {
                "object": subject.label,
                "family": subject.family,
                "holding": name,
                "friction": friction,
            }
            told |= {"push": push, "mass": mass, "status": done.status.name}
            told |= {"slip": done.slip.distance, "turn": done.slip.angle}
            pressed = int((done.time <= done.phases[2]).sum()) - 1
            for when, tick, most in (
                ("pressed", pressed, push),
                ("end", len(done.time) - 1, PUSHES[-1]),
            ):
                found = (
                    least_grip_at(done, tick, hand, mesh, mass, friction, most)
                    if tick >= 0
                    else (None, 0.0)
                )
                told[when] = found
            yield told


EDGES = 16
"""Edges of a linearised friction cone."""


def least_grip(
    points: Float[Tensor, "f 3"],
    normals: Float[Tensor, "f 3"],
    load: Float[Tensor, "6"],
    friction: float,
    torques: Float[Tensor, "f j 3"] | None = None,
    patch: float = 0.0,
) -> Float[Tensor, "f 3"] | None:
    """Return the forces with the least sum of normal forces that balance a load, or None where
    there are none.

    Args: points: contacts [m]. normals: outward unit normals. load: force [N] and torque about the
        mean of the contacts [N m] that the forces must sum to. friction: at every contact. torques:
        joint torques, over their limits, of a force of 1 N along each axis; None: without limit.
        patch: radius of the contacts [m], which add a torque about the normal of at most friction x
        force x patch.
    """
    p = points.double().numpy()
    n = normals.double().numpy()
    f = len(points)
    side = np.cross(n, np.eye(3)[np.abs(n).argmin(1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    angle = 2 * math.pi * np.arange(EDGES) / EDGES
    around = (
        np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * np.cross(n, side)[:, None]
    )
    edges = friction * around - n[:, None]  # (f, e, 3), each pushes with 1 N
    columns = np.zeros((3 * f, f * EDGES))
    for i in range(f):
        columns[3 * i : 3 * i + 3, i * EDGES : (i + 1) * EDGES] = edges[i].T
    arms = p - p.mean(0)
    wrench = np.concatenate(
        [np.tile(np.eye(3), f), np.concatenate([np.cross(arm, np.eye(3)).T for arm in arms], 1)]
    )
    size = np.repeat(
        [1.0, 1 / max(float(np.ptp(p, axis=0).max()), 1e-6)], 3
    )  # forces and torques alike
    spin = np.pad(n, ((0, 0), (3, 0))).T  # wrench of 1 N m about each normal
    room = friction * patch * np.kron(np.eye(f), np.ones(EDGES))
    limit = np.block([[-room, np.eye(f)], [-room, -np.eye(f)]])
    most = np.zeros(2 * f)
    if torques is not None:
        share = np.concatenate(list(torques.double().numpy()), axis=1) @ columns
        share = np.pad(np.concatenate([share, -share]), ((0, 0), (0, f)))
        limit = np.concatenate([limit, share])
        most = np.append(most, np.ones(len(share)))
    balance = size[:, None] * np.concatenate([wrench @ columns, spin], 1)
    wanted = size * load.double().numpy()
    cost = np.repeat([1.0, 0.0], [f * EDGES, f])
    bounds = [(0, None)] * (f * EDGES) + [(None, None)] * f
    found = linprog(cost, limit, most, balance, wanted, bounds)
    return (
        torch.from_numpy((columns @ found.x[: f * EDGES]).reshape(f, 3))
        if found.status == 0
        else None
    )


def least_grip_at(
    closure: ClosureResult,
    tick: int,
    hand: Hand,
    mesh: trimesh.Trimesh,
    mass: float,
    friction: float,
    push: float = 0.0,
) -> tuple[float | None, float]:
    """Return the least normal sum [N] that could hold the object at a tick of a trial, and the
    simulated sum.

    It carries the weight and a `push` [N] at the centre of mass, from the worst of 26 sides. None:
    the drives cannot hold the object, or fewer than two fingers touch it.
    """
    hand = hand.to("cpu", torch.float64)
    trace = closure.trace
    touching = torch.isfinite(trace.points[tick]).all(-1)
    spent = float(-(trace.forces[tick] * trace.normals[tick])[touching].sum())
    if int(touching.sum()) < 2:
        return None, spent
    hand_from_object = inverse(closure.hand_pose[tick]) @ closure.object_pose[tick]
    centre = apply(
        hand_from_object, torch.from_numpy(np.array(mesh.center_mass, dtype=np.float64))[None]
    )[0]
    places = [closure.joint_names.index(name) for name in hand.tree.joint_names]
    points = torch.where(touching[:, None], trace.points[tick], 0.0)
    jacobian = joint_jacobian(hand, closure.joints[tick][places], points)[touching]
    effort = torch.tensor(
        [hand.actuators[name].effort for name in hand.tree.joint_names], dtype=torch.float64
    )
    weight = (
        mass
        * 9.81
        * closure.hand_pose[tick][:3, :3].T
        @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    )
    points = points[touching]
    normals = trace.normals[tick][touching]
    least = 0.0
    for side in itertools.product((-1.0, 0.0, 1.0), repeat=3) if push else [(0.0, 0.0, 0.0)]:
        away = torch.tensor(side, dtype=torch.float64)
        force = weight + push * away / max(float(away.norm()), 1.0)
        load = torch.cat([force, torch.linalg.cross(centre - points.mean(0), force)])
        forces = least_grip(points, normals, load, friction, jacobian.mT / effort[:, None])
        if forces is None:
            return None, spent
        least = max(least, -float((forces * normals).sum()))
    return least, spent


def _row(
    hand: str, name: str, lifts: Sequence[dict[str, Any]], base: Sequence[dict[str, Any]]
) -> Row:
    """Return what one holding held of what can be held, and what force it spent."""
    can = {(x["object"], x["friction"]) for x in [*lifts, *base] if x["pressed"][0] is not None}
    mine, first, rest = (
        [x for x in some if ((x["object"], x["friction"]) in can) is holdable]
        for some, holdable in ((lifts, True), (base, True), (lifts, False))
    )
    held, before = (
        count_by((x["family"], x["status"] == "OK") for x in some) for some in (mine, first)
    )
    share = share_over(held)
    change = contrast_over([held, before], [1.0, -1.0])
    spent = [x["end"][1] / x["end"][0] for x in lifts if x["status"] == "OK" and x["end"][0]]
    most = statistics.median(spent) if spent else math.nan
    lost = dict(Counter(x["status"] for x in mine if x["status"] != "OK"))
    others = dict(Counter(x["status"] for x in rest))
    words = f"{format_share(share)}, change {format_points(change)}; lost {lost}"
    words += f"; of what cannot be held {others}; force {most:.2f}x of what suffices"
    bar = f">= {LEAST_HELD:.0%} of what can be held, <= {MOST_SPENT}x"
    met = share.value >= LEAST_HELD
    bar, met = (bar, met and most <= MOST_SPENT) if name == "grip" else ("-", None)
    numbers = {"share": share, "change": change, "spent": most, "lost": lost, "rest": others}
    return Row(f"held by holding {name}, {hand}", bar, words, met, numbers)
