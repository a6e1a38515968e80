"""How true the proofs are: certificates in rational arithmetic, the probability of closure on surfaces drawn anew."""

import time
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.common import Row, least_seconds, measure
from benchmarks.ground_truth import read_views
from benchmarks.plan.true_surface import closed_on_mesh
from benchmarks.proof.closure_reference import redrawn_closure
from benchmarks.proof.exact_lp import exact_margin, proves_margin_above, proves_margin_below, wrench_matrix
from torchgrasp.errors import Status
from torchgrasp.linalg import unit
from torchgrasp.objects import list_objects, load_object
from torchgrasp.plan.certify import certify, solve_by_highs
from torchgrasp.plan.closure_lp import solve_closure_lp
from torchgrasp.plan.closure_probability import closure_probability
from torchgrasp.plan.solve import plan_contacts
from torchgrasp.plan.wrench import MIN_MARGIN, wrenches
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Contacts

SUBJECTS = ("certificates", "probability", "objects")
FRICTIONS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.5, 2.0)
EDGES = (8, 8, 8, 8, 8, 3, 4, 5, 6, 12)


def proof(
    objects: Path | None = None,
    only: tuple[str, ...] = SUBJECTS,
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
        grasps: certificates that are checked.
        starts: of the planner, for each view.
        seed: of every draw.
        quick: a hundredth of the grasps.
        out: where the numbers are written as JSON.
    """
    torch.set_num_threads(1)
    grasps = grasps // 100 if quick else grasps
    subjects: dict[str, Callable[[], list[Row]]] = {
        "certificates": lambda: bench_certificates(grasps, seed),
        "probability": lambda: bench_probability(starts, seed),
        "objects": lambda: bench_objects(objects, starts, seed) if objects else [],
    }
    settings = {"grasps": grasps, "starts": starts, "seed": seed, "threads": 1}
    measure("proof", subjects, only, settings, out)


# ------------------------------------------------------------------------------------------------- certificates


def bench_certificates(grasps: int, seed: int) -> list[Row]:
    """Certify random triples, half of them at the border of closure, and prove every verdict in exact arithmetic."""
    generator = torch.Generator().manual_seed(seed)
    each = grasps // len(FRICTIONS)
    counts = {"closed": 0, "open": 0, "degenerate": 0}
    wrong, worst = 0, 0.0
    bound, sampled, aside = Fraction(MIN_MARGIN), 0, 0
    nearest: list[float] = []
    for friction, edges in tqdm(list(zip(FRICTIONS, EDGES, strict=True)), desc="frictions", disable=None, leave=False):
        spec = ContactSpec(friction=friction, edges=edges, friction_margin=1.0)
        contacts = border_triples(each, spec, generator)
        certificate = certify(contacts, spec)
        phi, _ = solve_closure_lp(
            wrenches(contacts.points, contacts.normals, spec.planned_friction, edges).flatten(1, 2)
        )
        nearest.append(float((certificate.margin - MIN_MARGIN).abs().median()))
        for i in range(each):
            points, normals = contacts.points[i].numpy(), contacts.normals[i].numpy()
            if not certificate.closed[i] and certificate.margin[i] >= MIN_MARGIN:
                counts["degenerate"] += 1
                wrong += not has_low_rank(points, normals, friction, edges)
                continue
            matrix = wrench_matrix(points, normals, friction, edges)
            if certificate.closed[i]:
                counts["closed"] += 1
                wrong += not proves_margin_above(matrix, phi[i].numpy(), bound)
            else:
                counts["open"] += 1
                wrong += not proves_margin_below(matrix, certificate.witness[i].numpy(), bound)
            if i % 50 == 0 and torch.isfinite(certificate.margin[i]):
                try:
                    exact = float(exact_margin(matrix))
                except ArithmeticError:
                    aside += 1
                    continue
                sampled += 1
                worst = max(worst, abs(exact - float(certificate.margin[i])))
    total = sum(counts.values())
    spec = ContactSpec(friction=0.5, friction_margin=1.0)
    contacts = random_contacts(10_000, generator)
    fast = least_seconds(lambda: certify(contacts, spec)) / len(contacts)
    matrices = wrenches(contacts.points[:100], contacts.normals[:100], 0.5, 8).flatten(1, 2).numpy()
    slow = least_seconds(lambda: [solve_by_highs(m) for m in matrices], 3) / len(matrices)
    return [
        Row(
            f"certificates: {total} triples at 10 frictions, half within 1e-3 of the border, in exact arithmetic",
            "0 wrong",
            f"{wrong} wrong ({counts['closed']} closed, {counts['open']} open, {counts['degenerate']} lack rank); "
            f"margins of {sampled} against an exact programme: largest difference {worst:.1e}; {aside} more have "
            "no feasible basis among the coefficients that HiGHS leaves",
            wrong == 0 and worst < 1e-7,
            {"wrong": wrong, "counts": counts, "worst": worst, "aside": aside, "median_from_border": nearest},
        ),
        Row(
            "certificates per second, 10^4 at once, one thread, against one HiGHS programme after the other",
            "-",
            f"{1 / fast:.0f} against {1 / slow:.0f} per second: {slow / fast:.0f}x",
            None,
            {"seconds": fast, "highs_seconds": slow},
        ),
    ]


def random_contacts(count: int, generator: torch.Generator, lean: float = 0.45) -> Contacts:
    """Return random triples with normals that lean away from their centre; the smaller `lean`, the more are closed."""
    points, noise = (torch.randn(count, 3, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    return Contacts(points, unit(unit(points - points.mean(1, keepdim=True)) + lean * noise))


def border_triples(count: int, spec: ContactSpec, generator: torch.Generator) -> Contacts:
    """Return random triples; the normals of every second one are turned to the border of closure and a little on."""
    contacts = random_contacts(count, generator)
    half = count // 2
    points, far = contacts.points[:half], contacts.normals[:half]
    near = unit(points - points.mean(1, keepdim=True))
    low, high = torch.zeros(half, 1, 1, dtype=torch.float64), torch.full((half, 1, 1), 2.0, dtype=torch.float64)
    for _ in range(45):
        middle = (low + high) / 2
        closed = certify(Contacts(points, unit(near + middle * (far - near))), spec).closed[:, None, None]
        low, high = torch.where(closed, middle, low), torch.where(closed, high, middle)
    step = 10 ** (-3 - 7 * torch.rand(half, 1, 1, generator=generator, dtype=torch.float64))
    sign = torch.sign(torch.randn(half, 1, 1, generator=generator, dtype=torch.float64))
    turned = unit(near + (low + sign * step) * (far - near))
    return Contacts(contacts.points, torch.cat([turned, contacts.normals[half:]]))


def has_low_rank(points: np.ndarray, normals: np.ndarray, friction: float, edges: int) -> bool:
    """Tell whether wrenches written anew lack rank, or the triangle is flat, to the thresholds of the library."""
    values = np.linalg.svd(wrench_matrix(points, normals, friction, edges).astype(float), compute_uv=False)
    sides = points - np.roll(points, 1, 0)
    area = np.linalg.norm(np.cross(sides[0], sides[1]))
    return bool(values[-1] < 1.001e-3 * values[0] or area < 1.001e-3 * (sides**2).sum(1).max())


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
