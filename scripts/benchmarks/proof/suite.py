"""How true the proofs are: certificates in rational arithmetic, the probability of closure on surfaces drawn anew."""

import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.common import Row, measure
from benchmarks.ground_truth import read_views
from benchmarks.plan.true_surface import closed_on_mesh
from benchmarks.proof.certificates import bench_certificates
from benchmarks.proof.closure_reference import redrawn_closure
from torchgrasp.data.shipped import list_objects, load_object
from torchgrasp.errors import Status
from torchgrasp.plan.certify import certify
from torchgrasp.plan.closure_probability import closure_probability
from torchgrasp.plan.solve import plan_contacts
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Contacts

SUBJECTS = ("certificates", "probability", "objects")


def proof(
    objects: Path | None = None,
    only: tuple[str, ...] = SUBJECTS,
    fingertips: tuple[int, ...] = (3, 4, 5),
    grasps: int = 100_000,
    starts: int = 300,
    seed: int = 0,
    quick: bool = False,
    out: Path = Path("out/bench_proof.json"),
) -> None:
    """Hold certificates against rational arithmetic, and the probability of closure against surfaces drawn anew.

    Args:
        objects: folder with manifest.json and a folder for each object: what the probability says of true surfaces.
        only: subjects to measure, of certificates, probability, objects.
        fingertips: numbers of contacts whose certificates are checked.
        grasps: certificates that are checked of each number of contacts.
        starts: of the planner, for each view.
        seed: of every draw.
        quick: a hundredth of the grasps.
        out: where the numbers are written as JSON.
    """
    torch.set_num_threads(1)
    grasps = grasps // 100 if quick else grasps
    subjects: dict[str, Callable[[], list[Row]]] = {
        "certificates": lambda: [row for f in fingertips for row in bench_certificates(f, grasps, seed)],
        "probability": lambda: bench_probability(starts, seed),
        "objects": lambda: bench_objects(objects, starts, seed) if objects else [],
    }
    settings = {"grasps": grasps, "starts": starts, "seed": seed, "threads": 1}
    measure("proof", subjects, only, settings, out)


# -------------------------------------------------------------------------------------------------- probability


def certified(shape: ShapeGP, spec: ContactSpec, starts: int, seed: int) -> tuple[Contacts, Tensor]:
    """Return the certified contacts of a plan, and the margins of their certificates."""
    plan = plan_contacts(shape, spec, starts, seed)
    good = plan.contacts[plan.status == Status.OK]
    certificate = certify(good, spec)
    return good[certificate.closed], certificate.margin[certificate.closed]


def bench_probability(starts: int, seed: int) -> list[Row]:
    """Hold the probability against surfaces drawn anew, on the project's own objects."""
    spec = ContactSpec(table=0.0)
    names = list_objects()
    shapes = {name: fit_shape(load_object(name).view, table=0.0) for name in names}
    plans = {name: certified(shapes[name], spec, starts, seed)[0] for name in names}
    differences, errors, shares = [], [], {}
    seconds, count = 0.0, 0
    for name in names:
        began = time.process_time()
        whole = closure_probability(shapes[name], plans[name], spec, seed=seed)
        seconds, count = seconds + time.process_time() - began, count + len(plans[name])
        shares[name] = {
            f"{friction:g}": mean_probability(shapes[name], plans[name], friction) for friction in (0.4, 0.6, 0.8)
        }
        for friction in (0.4, 0.8):
            few = plans[name][:: max(len(plans[name]) // 10, 1)][:10]
            ours = closure_probability(shapes[name], few, ContactSpec(friction), seed=seed)
            again = redrawn_closure(shapes[name], few, friction, 2500, seed + 1)
            differences.append(again - ours.probability)
            errors.append(ours.standard_error * 2**0.5)
        assert float(whole.standard_error.max()) <= 0.01
    difference, error = torch.cat(differences), torch.cat(errors)
    within = float((difference.abs() <= 3 * error).double().mean())
    return [
        Row(
            "probability of closure against surfaces drawn anew, 4 objects x 10 plans x frictions .4 and .8",
            "standard error <= 0.01; within 3 standard errors",
            f"standard error <= 0.01; {within:.0%} within 3; difference {difference.mean():+.3f} on average, median "
            f"{difference.abs().median():.3f}, largest {difference.abs().max():.3f}; "
            f"{1e3 * seconds / count:.1f} ms a grasp",
            within == 1.0,
            {"difference": difference.tolist(), "error": error.tolist(), "seconds": seconds / count},
        ),
        Row(
            "certified plans (planned at .4) that stay closed on drawn surfaces, at friction .4 / .6 / .8",
            "-",
            "; ".join(f"{name} " + " / ".join(f"{share:.2f}" for share in shares[name].values()) for name in names),
            None,
            shares,
        ),
    ]


def mean_probability(shape: ShapeGP, contacts: Contacts, friction: float) -> float:
    """Return the share of drawn surfaces on which certified triples stay closed."""
    return float(closure_probability(shape, contacts, ContactSpec(friction)).probability.mean())


# ---------------------------------------------------------------------------------------------- on true surfaces


Asked = dict[str, Tensor]
"""Scores of the certified triples of one view by name, and "true": whether they are closed on the true surface."""


def bench_objects(objects: Path, starts: int, seed: int) -> list[Row]:
    """Ask whether the probability foretells which certified triples are closed on the true surface at friction .6."""
    specs = {
        "default spec": ContactSpec(table=0.0),
        "paper's spec at friction .6": ContactSpec.paper(friction=0.6),
    }
    asked: dict[str, list[Asked]] = {name: [] for name in specs}
    for _, _, cloud, mesh in tqdm(list(read_views(objects)), desc="views", disable=None, leave=False):
        shape = fit_shape(cloud, table=0.0)
        for name, spec in specs.items():
            contacts, margin = certified(shape, spec, starts, seed)
            if not len(contacts):
                continue
            closure = closure_probability(shape, contacts, ContactSpec(friction=0.6), seed=seed)
            true = closed_on_mesh(contacts, mesh)
            asked[name].append(
                {
                    "probability": closure.probability,
                    "sum of variances": -contacts.require_std().square().sum(1),
                    "margin": margin,
                    "true": true,
                }
            )
    return [foretell(name, views) for name, views in asked.items()]


def foretell(name: str, views: list[Asked]) -> Row:
    """Return the row of how well each score tells the triples that are closed on the true surface from the others."""
    scores = [score for score in views[0] if score != "true"]
    within = {score: area_under_curve(views, score) for score in scores}
    pooled = {score: torch.cat([view[score] for view in views]) for score in (*scores, "true")}
    over_all = {score: area_under_curve([pooled], score) for score in scores}
    edges = torch.tensor([0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 1.01], dtype=torch.float64)
    bins = torch.bucketize(pooled["probability"], edges, right=True) - 1
    reliability = []
    for k in range(len(edges) - 1):
        rows = bins == k
        if bool(rows.any()):
            said, is_so = pooled["probability"][rows].mean(), pooled["true"][rows].double().mean()
            reliability.append((float(said), float(is_so), int(rows.sum())))
    first = torch.stack([view["true"][view["probability"].argmax()] for view in views]).double().mean()
    return Row(
        f"closed on the true surface at .6 of {len(pooled['true'])} certified triples, {len(views)} views, {name}",
        "-",
        f"{pooled['true'].double().mean():.2f} (the most probable of each view: {first:.2f}); said -> true (triples): "
        + ", ".join(f"{said:.2f} -> {is_so:.2f} ({count})" for said, is_so, count in reliability)
        + "; area under the curve within views / pooled: "
        + ", ".join(f"{score} {within[score]:.2f} / {over_all[score]:.2f}" for score in scores),
        None,
        {"within": within, "pooled": over_all, "reliability": reliability, "first": float(first)},
    )


def area_under_curve(views: list[Asked], score: str) -> float:
    """Return the share of pairs of a closed and an open triple of the same view that a score orders rightly."""
    right = pairs = 0.0
    for view in views:
        yes, no = view[score][view["true"]], view[score][~view["true"]]
        right += float((yes[:, None] > no).double().sum() + 0.5 * (yes[:, None] == no).double().sum())
        pairs += len(yes) * len(no)
    return right / pairs if pairs else float("nan")
