"""Stability: what a hand's stability model knows of unseen objects, and at which pull held objects are lost."""

import dataclasses
import functools
import math
from pathlib import Path

import numpy as np
import torch
from train.pull_trials import PullRecord, RisingPull, pull_until_lost

from benchmarks.common import Row
from benchmarks.ground_truth import read_views
from torchgrasp import ContactSpec, Grasps, Hand, Status, load_hand, plan_grasps
from torchgrasp.control import ClosingReference
from torchgrasp.control.holding import ForceHold
from torchgrasp.control.paper.impedance import GRASP_STIFFNESS, Impedance
from torchgrasp.control.paper.stability import StabilityModel, lengths_of, load_stability, state_of
from torchgrasp.evaluation.closing import GraspTrial
from torchgrasp.evaluation.views import choose_rows
from torchgrasp.geometry.linalg import unit
from torchgrasp.sim.convex_parts import convex_parts

FRICTION, STRENGTH = 0.6, (1.0, 8.0)
"""Of every contact; and the strongest finger's desired force [N], drawn evenly in its logarithm for each grasp."""

RATE, MOST, SECONDS = 4.0, 16.0, 4.0
"""Rate [N/s], end [N] and duration [s] of the rising pull."""

AGAINST = 3.0
"""Pull [N] for which the stability before it is judged."""

HOLDINGS = ("force", "impedance", "impedance that adapts", "impedance that adapts, learned forces")
"""Holdings that are compared; the last takes its desired forces from the stability model, too."""


@dataclasses.dataclass(frozen=True)
class Held:
    """One grasp under a rising pull: the pull at its loss [N], the log-odds before it, and the error of its forces."""

    lost_at: float
    log_odds: float
    error: float


def bench_stability(objects: Path, tries: int, starts: int, seed: int) -> list[Row]:
    """Pull at `tries` grasps of the first view of every object until they are lost, with both hands."""
    rows: list[Row] = []
    for hand in (load_hand("allegro"), load_hand("barrett")):
        model = load_stability(hand)
        assert model is not None
        results: dict[str, list[Held]] = {name: [] for name in HOLDINGS}
        for _, view, cloud, mesh in read_views(objects):
            if view != "view0":
                continue
            grasps = plan_grasps(cloud, hand, ContactSpec(friction=FRICTION, table=0.0), starts, seed)
            grasps, parts = grasps[grasps.status == Status.OK], convex_parts(mesh)
            for row in choose_rows(len(grasps), tries, "spread"):
                held = pull_at(grasps[row], hand, model, mesh, parts, 1000 * seed + row)
                for name, one in held.items():
                    results[name].append(one)
        rows += [likelihood_row(hand, model), odds_row(hand, results["impedance"]), error_row(hand, results)]
        rows += [lost_row(hand, results)]
    return rows


def pull_at(grasp: Grasps, hand: Hand, model: StabilityModel, mesh, parts, seed: int) -> dict[str, Held]:
    """Pull at one grasp under each holding, with the same draws; nothing where the hand starts in the object."""
    generator = torch.Generator().manual_seed(seed)
    share = float(torch.rand((), generator=generator, dtype=torch.float64))
    strength = math.exp(math.log(STRENGTH[0]) + share * math.log(STRENGTH[1] / STRENGTH[0]))
    pull = RisingPull(unit(torch.randn(3, generator=generator, dtype=torch.float64)), RATE, MOST, SECONDS)
    held: dict[str, Held] = {}
    for name in HOLDINGS:
        learned, adapts = name.endswith("learned forces"), "adapts" in name
        reference = ClosingReference.from_grasp(hand, grasp, strength, stability=model if learned else None)
        impedance = functools.partial(Impedance, stability=model if adapts else None)
        holding = ForceHold if name == "force" else impedance
        given = GraspTrial(hand, grasp, mesh, seed, parts=parts)
        trial = pull_until_lost(given, reference, holding, pull, FRICTION)
        if trial.overlap:
            return {}
        held[name] = score(trial, model, reference.gains.desired_force.norm(dim=-1))
    return held


def score(trial: PullRecord, model: StabilityModel, desired: torch.Tensor) -> Held:
    """Return the loss of a trial, and log-odds and error of its forces before the pull."""
    rest = max(int((trial.pulled == 0).sum()) - 1, 0)  # the forces have risen by then
    forces = trial.forces[rest]
    state = state_of(torch.full((3,), GRASP_STIFFNESS, dtype=torch.float64), lengths_of(trial.tips[rest]), forces)
    error = float(((forces - desired) / desired).abs().mean())
    return Held(float(trial.pulled[-1]) if trial.lost else MOST, float(model.log_odds(state)), error)


def likelihood_row(hand: Hand, model: StabilityModel) -> Row:
    """Return the training's scores on bodies left out."""
    scores = {name: float(model.meta[name]) for name in ("log_likelihood", "log_likelihood_of_one_gaussian", "auc")}
    measured = (
        f"{scores['log_likelihood']:.2f} nats a state, one Gaussian {scores['log_likelihood_of_one_gaussian']:.2f};"
        f" AUC of the odds {scores['auc']:.2f}, of the density alone {float(model.meta['auc_of_the_density']):.2f}"
    )
    return Row(f"{hand.name}: the model of stable grasps on authored bodies left out", "-", measured, None, scores)


def odds_row(hand: Hand, held: list[Held]) -> Row:
    """Return how well the odds before the pull rank unseen grasps."""
    kept, lost = ([h.log_odds for h in held if (h.lost_at > AGAINST) is which] for which in (True, False))
    pairs = np.subtract.outer(kept, lost)
    auc = float(((pairs > 0) + 0.5 * (pairs == 0)).mean()) if pairs.size else math.nan
    measured = f"AUC {auc:.2f} over {len(held)} grasps, {len(lost)} of them lost below {AGAINST:g} N"
    return Row(f"{hand.name}: odds of stability on unseen objects", "> 0.5", measured, auc > 0.5, {"auc": auc})


def error_row(hand: Hand, results: dict[str, list[Held]]) -> Row:
    """Return how far the forces at rest are from the desired ones."""
    errors = {name: float(np.median([h.error for h in held])) for name, held in results.items()}
    measured = ", ".join(f"{name} {error:.0%}" for name, error in errors.items())
    return Row(f"{hand.name}: median error of the normal forces at rest", "-", measured, None, errors)


def lost_row(hand: Hand, results: dict[str, list[Held]]) -> Row:
    """Return the mean pull at which the object is lost, and the paired gain over the holding by forces."""
    pulls = {name: np.array([h.lost_at for h in held]) for name, held in results.items()}
    base, parts, numbers = pulls["force"], [], {}
    for name, at in pulls.items():
        gain = at - base
        width = 1.96 * float(gain.std()) / math.sqrt(max(len(gain), 1))
        numbers[name] = {"mean": float(at.mean()), "gain": float(gain.mean()), "width": width}
        parts.append(f"{name} {at.mean():.2f} N ({gain.mean():+.2f} +- {width:.2f})")
    best = numbers["impedance that adapts"]
    title = f"{hand.name}: mean pull at which {len(base)} held objects are lost"
    return Row(title, "adapting above force", "; ".join(parts), best["gain"] > best["width"], numbers)
