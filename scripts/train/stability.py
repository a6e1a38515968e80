"""The learned model of a hand's stable grasps: bodies are grasped and pulled at, and a mixture
learns those that held.

python scripts/train.py stability allegro --workers 2
"""

import dataclasses
import functools
import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import trimesh
import tyro
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from torchgrasp import (
    ClosingReference,
    ContactSpec,
    Grasps,
    Hand,
    PointCloud,
    Status,
    list_objects,
    load_hand,
    load_object,
    plan_grasps,
)
from torchgrasp.control.paper.closings import Impedance
from torchgrasp.control.paper.stability import FILE, NAMES, StabilityModel, lengths_of, state_of
from torchgrasp.evaluation.trial import GraspTrial, Truth
from torchgrasp.files import load_tensors, save_tensors
from torchgrasp.foundation.base import Batch
from torchgrasp.foundation.errors import BadArgument, GraspError
from torchgrasp.foundation.jobs import run_tasks
from torchgrasp.geometry.frames import rigid, rotation_from_vector
from torchgrasp.geometry.linalg import unit
from torchgrasp.posture_model.em import DataRows, EmRule, expectation_maximisation, start_components
from torchgrasp.posture_model.gaussian import GaussianMixture
from torchgrasp.posture_model.mixture import describe_compatibility
from train.pull_trials import PullRecord, RisingPull, pull_until_lost

SIZES = {
    "box": [
        (0.04, 0.06, 0.13),
        (0.05, 0.05, 0.05),
        (0.03, 0.09, 0.16),
        (0.07, 0.07, 0.10),
        (0.06, 0.10, 0.04),
    ],
    "cylinder": [(0.018, 0.14), (0.026, 0.17), (0.034, 0.10), (0.042, 0.13)],
    "ellipsoid": [
        (0.025, 0.025, 0.06),
        (0.035, 0.035, 0.035),
        (0.045, 0.03, 0.055),
        (0.03, 0.05, 0.08),
    ],
}
"""Edges, radius and height, and half axes of simple bodies [m]."""

BODIES = (
    *(f"{kind}{k}" for kind, sizes in SIZES.items() for k in range(len(sizes))),
    *list_objects(),
)

POINTS = 1000
STARTS = 300
GRASPS = 16
"""Points of the cloud on which each body's grasps are planned, starts of the planner, and the best
grasps kept.
"""

STRENGTH = (1.0, 8.0)
SPRINGS = (20.0, 500.0)
FRICTION = (0.4, 1.0)
PULL = (0.5, 6.0)
"""What is drawn for each trial: the strongest finger's force [N], the springs [N/m] (both evenly in
their logarithm), friction, and the pull [N].
"""

SHIFT = 0.005
TURN = math.radians(5)
"""Largest error of the hand's pose along and about each of its axes [m, rad]."""

SLIP = 0.01
TILT = math.radians(15)
"""Motion [m] and turn [rad] under the pull up to which a grasp counts as stable."""

REGULARISATION = 0.05
"""Variance that a fit adds to every number, relative to its variance over the few hundred trials.
"""
FITTING = EmRule(iterations=300, tolerance=1e-4, regularisation=REGULARISATION)


def body(name: str) -> tuple[trimesh.Trimesh, list[trimesh.Trimesh]]:
    """Return a body's mesh [m], standing at z = 0, and its convex parts."""
    if name in list_objects():
        known = load_object(name)
        return known.mesh, known.parts
    kind = name[:-1]
    size = SIZES[name[:-1]][int(name[-1])]
    if kind == "box":
        mesh = trimesh.creation.box(size)
    elif kind == "cylinder":
        mesh = trimesh.creation.cylinder(radius=size[0], height=size[1], sections=64)
    else:
        mesh = trimesh.creation.icosphere(subdivisions=2)
        mesh.apply_scale(size)
    mesh.apply_translation([0, 0, -mesh.bounds[0, 2]])
    return mesh, [mesh]


def pull_body(hand_name: str, name: str, trials: int, seed: int) -> list[dict[str, Any]]:
    """Pull at grasps of one body; return the states of each before and under the pull, and how it
    ended.
    """
    hand = load_hand(hand_name)
    mesh, parts = body(name)
    grasps = grasps_of(name, hand, mesh, seed)
    rows = []
    for k in range(trials if len(grasps) else 0):
        generator = torch.Generator().manual_seed(1_000_000 * seed + 1000 * BODIES.index(name) + k)
        grasp = grasps[int(torch.randint(len(grasps), (1,), generator=generator))]
        trial = pull_once(hand, grasp, mesh, parts, generator, k)
        if not trial.overlap:
            rows.append({"body": float(BODIES.index(name)), **summary(trial)})
    return rows


def grasps_of(name: str, hand: Hand, mesh: trimesh.Trimesh, seed: int) -> Grasps:
    """Plan grasps of a body that is seen from all around."""
    points, faces = trimesh.sample.sample_surface(mesh, POINTS, seed=seed)  # pyright: ignore[reportAssignmentType]
    cloud = PointCloud(
        torch.from_numpy(np.array(points)), torch.from_numpy(np.array(mesh.face_normals[faces]))
    )
    grasps = plan_grasps(cloud, hand, ContactSpec(), STARTS, seed)
    return grasps[grasps.status == Status.OK][:GRASPS]


def pull_once(
    hand: Hand,
    grasp: Grasps,
    mesh: trimesh.Trimesh,
    parts: list[trimesh.Trimesh],
    generator: torch.Generator,
    seed: int,
) -> PullRecord:
    """Pull at one grasp; everything is drawn by the trial's own generator."""

    def draw(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))

    strength = math.exp(draw(*map(math.log, STRENGTH)))
    springs = torch.tensor(
        [math.exp(draw(*map(math.log, SPRINGS))) for _ in range(3)], dtype=torch.float64
    )
    friction = draw(*FRICTION)
    most = draw(*PULL)
    direction = unit(torch.randn(3, generator=generator, dtype=torch.float64))
    off = 2 * torch.rand(6, generator=generator, dtype=torch.float64) - 1
    error = rigid(rotation_from_vector(TURN * off[:3]), SHIFT * off[3:])
    reference = ClosingReference.from_grasp(hand, grasp, strength)
    holding = functools.partial(Impedance, springs=springs)
    trial = GraspTrial(hand, grasp, Truth(mesh, parts, error), seed)
    pull = RisingPull(direction, most / 0.3, most, 0.8)
    return pull_until_lost(trial, reference, holding, pull, friction)


def summary(trial: PullRecord) -> dict[str, Any]:
    """Return the states (`NAMES`) before the pull and at the last moment before the object slipped,
    and the end.
    """
    rest = max(int((trial.pulled == 0).sum()), 1)
    slipped = torch.nonzero(trial.moved[rest:] > SLIP)[:, 0]
    last = rest + (int(slipped[0]) if len(slipped) else len(trial.moved) - rest)
    stable = (
        len(slipped) == 0 and float(trial.turned[-1]) < TILT and float(trial.forces[-1].min()) > 0.1
    )
    moments = {"before": slice(max(rest - 2, 0), rest), "late": slice(max(last - 2, 0), last)}
    states = {
        name: state_of(
            trial.springs[rows].mean(0),
            lengths_of(trial.tips[rows]).mean(0),
            trial.forces[rows].mean(0),
        )
        for name, rows in moments.items()
    }
    return {
        "lost": float(trial.lost),
        "stable": float(stable),
        **{name: x.tolist() for name, x in states.items()},
    }


@dataclasses.dataclass(frozen=True)
class PullTrials(Batch):
    """Trials: states before the pull and late under it, the body's number, and whether it was lost
    or stable.
    """

    before: Float[Tensor, "n 9"]
    late: Float[Tensor, "n 9"]
    body: Float[Tensor, "n"]
    lost: Float[Tensor, "n"]
    stable: Float[Tensor, "n"]

    def fit(self, components: int, seed: int, meta: dict[str, str] | None = None) -> StabilityModel:
        """Learn from both moments of every trial."""
        held = self.stable > 0
        stable, others = (torch.cat([self.before[rows], self.late[rows]]) for rows in (held, ~held))
        return fit_stability(stable, others, components, meta, seed)


TENSORS = tuple(field.name for field in dataclasses.fields(PullTrials))
"""What a file of trials holds."""


def fit_stability(
    stable: Float[Tensor, "n 9"],
    others: Float[Tensor, "k 9"],
    components: int,
    meta: dict[str, str] | None = None,
    seed: int = 0,
) -> StabilityModel:
    """Fit a mixture of some components to the states of stable grasps, and one to the states of all
    others.

    Raises:
        BadArgument: hardly more states than a component has dimensions.
        IndefiniteCovariance: a component collapsed.
    """
    share = len(stable) / (len(stable) + len(others))
    return StabilityModel(
        _fit(stable, components, seed), _fit(others, components, seed), share, meta or {}
    )


def _fit(states: Float[Tensor, "n 9"], components: int, seed: int) -> GaussianMixture:
    """Fit one mixture to standardised states."""
    n, d = states.shape
    if not 1 <= components <= n // (d + 2):
        raise BadArgument("components", f"{components} for {n} states", f"1 to {n // (d + 2)}")
    centre = states.mean(0)
    scale = states.std(0, correction=0)
    shard = DataRows((states - centre) / scale)
    start = start_components(shard, components, seed, REGULARISATION)
    fitted = expectation_maximisation(shard, start, FITTING).components
    covariances = fitted.covariances * scale[:, None] * scale
    return GaussianMixture(fitted.weights, fitted.means * scale + centre, covariances, NAMES)


def run_trials(hand: str, trials: int, seed: int, workers: int) -> PullTrials:
    """Run the trials of every body, in the same order whatever the number of workers."""
    tasks = [(hand, name, trials, seed) for name in BODIES]
    done: list[dict[str, Any]] = []
    for rows in tqdm(
        run_tasks(pull_body, tasks, workers, limit=3600), "bodies", len(tasks), disable=None
    ):
        if isinstance(rows, Status):
            raise GraspError(f"the trials of a body failed: {rows.sentence}")
        done += rows
    return PullTrials(
        *(torch.tensor([row[name] for row in done], dtype=torch.float64) for name in TENSORS)
    )


def cross_validate(trials: PullTrials, components: int, seed: int) -> dict[str, float]:
    """Return the scores of the model, and of a single Gaussian, each on a body that it was not
    fitted on.
    """
    odds, density, single = torch.zeros(3, len(trials), dtype=torch.float64)
    for body in trials.body.unique():
        out = trials.body == body
        model, other = (trials[~out].fit(m, seed) for m in (components, 1))
        late = trials.late[out]
        odds[out] = model.log_odds(late)
        density[out] = model.stable.log_prob(late)
        single[out] = other.stable.log_prob(late)
    stable = trials.stable > 0
    lost = trials.lost > 0
    return {
        "auc": area(odds[stable], odds[lost]),
        "auc_of_the_density": area(density[stable], density[lost]),
        "log_likelihood": float(density[stable].mean()),
        "log_likelihood_of_one_gaussian": float(single[stable].mean()),
    }


def area(high: Float[Tensor, "n"], low: Float[Tensor, "m"]) -> float:
    """Return the area under the ROC curve: the share of pairs in which `high` is higher, ties
    counted half.
    """
    return float(
        (high[:, None] > low).double().mean() + 0.5 * (high[:, None] == low).double().mean()
    )


def stability(
    hand: Annotated[str, tyro.conf.Positional],
    trials: int = 20,
    components: int | None = None,
    seed: int = 0,
    workers: int = 1,
    keep: Path | None = None,
    out: Path | None = None,
) -> None:
    """Learn which grasps of a hand are stable from simulated pulls.

    Args:
        hand: name of a shipped hand, or the folder of another.
        trials: of each body.
        components: Gaussians of each mixture; default: 1 to 3, whichever is likeliest on bodies
            left out.
        seed: of every draw.
        workers: processes that run trials.
        keep: file in which the trials are kept, and from which they are taken where it exists.
        out: file to write; default: stability.safetensors in the hand's folder.
    """
    torch.set_num_threads(1)  # small products: further threads only spin
    robot = load_hand(hand)
    if keep is not None and keep.exists():
        done = PullTrials(**load_tensors(keep, "pull_trials", set(TENSORS))[0])
    else:
        done = run_trials(hand, trials, seed, workers)
        if keep is not None:
            save_tensors(
                keep, "pull_trials", {name: getattr(done, name) for name in TENSORS}, {"hand": hand}
            )
    stable = int(done.stable.sum())
    lost = int(done.lost.sum())
    print(f"{robot.name}: {len(done)} trials on {len(BODIES)} bodies, {stable} stable, {lost} lost")
    scores = {
        m: cross_validate(done, m, seed)
        for m in ((1, 2, 3) if components is None else (components,))
    }
    components = max(scores, key=lambda m: scores[m]["log_likelihood"])
    best = scores[components]
    print(
        f"{components} Gaussians: "
        + ", ".join(f"{name} {value:.3f}" for name, value in best.items())
    )
    meta = {
        **describe_compatibility(robot),
        "joint_names": ",".join(robot.joint_names),
        "bodies": ",".join(BODIES),
    }
    meta |= {"trials": str(len(done)), "stable": str(stable), "seed": str(seed)}
    model = done.fit(components, seed, meta | {k: f"{v:.4f}" for k, v in best.items()})
    print(f"written: {model.save(out or robot.urdf_path.parent / FILE)}")
