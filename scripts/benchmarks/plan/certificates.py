"""Certificates of random contacts, many at the border of closure, against rational arithmetic; and
their speed.
"""

from collections import Counter
from fractions import Fraction
from itertools import combinations

import numpy as np
import torch
from tqdm import tqdm

from benchmarks.common import Options, Row, bench, least_seconds
from benchmarks.plan.exact_lp import (
    exact_margin,
    proves_margin_above,
    proves_margin_below,
    wrench_matrix,
)
from torchgrasp.contacts.certify import certify, solve_by_highs
from torchgrasp.contacts.form_closure import MIN_MARGIN, solve_closure_lp, wrenches
from torchgrasp.geometry.linalg import unit
from torchgrasp.values.planning import Contacts
from torchgrasp.values.specs import ContactSpec

FRICTIONS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.5, 2.0)
EDGES = (8, 8, 8, 8, 8, 3, 4, 5, 6, 12)


@bench("plan/certificates")
def certificates(o: Options) -> list[Row]:
    """Compare certificates of 3 to 5 contacts with exact arithmetic."""
    return [
        row for f in (3, 4, 5) for row in bench_certificates(f, max(o.times(100_000), 20), o.seed)
    ]


def bench_certificates(fingertips: int, grasps: int, seed: int) -> list[Row]:
    """Certify random contacts, half of them at the border of closure, and prove every verdict in
    exact arithmetic.
    """
    generator = torch.Generator().manual_seed(seed)
    each = grasps // len(FRICTIONS)
    counts = Counter[str]()
    margins = list[tuple[float, float]]()
    nearest = list[float]()
    for friction, edges in tqdm(
        list(zip(FRICTIONS, EDGES, strict=True)), desc="frictions", disable=None, leave=False
    ):
        spec = ContactSpec(friction=friction, edges=edges, friction_margin=1.0)
        contacts = border_contacts(each, fingertips, spec, generator)
        certificate = certify(contacts, spec)
        matrices = wrenches(
            contacts.points, contacts.normals, spec.planned_friction, edges
        ).flatten(1, 2)
        phi, _ = solve_closure_lp(matrices)
        nearest.append(float((certificate.margin - MIN_MARGIN).abs().median()))
        for i in range(each):
            points = contacts.points[i].numpy()
            normals = contacts.normals[i].numpy()
            margin = float(certificate.margin[i])
            closed = bool(certificate.closed[i])
            if not closed and margin >= MIN_MARGIN:
                counts.update(
                    degenerate=1, wrong=not has_low_rank(points, normals, friction, edges)
                )
                continue
            matrix = wrench_matrix(points, normals, friction, edges)
            if closed:
                counts.update(
                    closed=1,
                    wrong=not proves_margin_above(matrix, phi[i].numpy(), Fraction(MIN_MARGIN)),
                )
            else:
                witness = certificate.witness[i].numpy()
                counts.update(
                    open=1, wrong=not proves_margin_below(matrix, witness, Fraction(MIN_MARGIN))
                )
            if i % 50 == 0 and np.isfinite(margin):
                try:
                    margins.append((float(exact_margin(matrix)), margin))
                except ArithmeticError:
                    counts["aside"] += 1
    return [_proof_row(fingertips, counts, margins, nearest), _speed_row(fingertips, generator)]


def _proof_row(
    fingertips: int, counts: Counter[str], margins: list[tuple[float, float]], nearest: list[float]
) -> Row:
    """Return how many verdicts are wrong, and the largest difference of a margin from the exact
    one.
    """
    worst = max((abs(exact - margin) for exact, margin in margins), default=0.0)
    verdicts = {kind: counts[kind] for kind in ("closed", "open", "degenerate")}
    what = f"certificates: {sum(verdicts.values())} rows of {fingertips} contacts at 10 frictions, half near the border"
    measured = (
        f"{counts['wrong']} wrong ({', '.join(f'{count} {kind}' for kind, count in verdicts.items())}); margins of "
        f"{len(margins)} against an exact programme: largest difference {worst:.1e}; {counts['aside']} more have no "
        "feasible basis among the coefficients that HiGHS leaves"
    )
    numbers = {"counts": dict(counts), "worst": worst, "median_from_border": nearest}
    return Row(
        f"{what}, in exact arithmetic",
        "0 wrong",
        measured,
        counts["wrong"] == 0 and worst < 1e-7,
        numbers,
    )


def _speed_row(fingertips: int, generator: torch.Generator) -> Row:
    """Return how many certificates are made in a second."""
    spec = ContactSpec(friction=0.5, friction_margin=1.0)
    contacts = random_contacts(10_000, generator, fingertips=fingertips)
    fast = least_seconds(lambda: certify(contacts, spec)) / len(contacts)
    matrices = wrenches(contacts.points[:100], contacts.normals[:100], 0.5, 8).flatten(1, 2).numpy()
    slow = least_seconds(lambda: [solve_by_highs(m) for m in matrices], 3) / len(matrices)
    what = f"certificates of {fingertips} contacts per second, 10^4 at once, one thread, against HiGHS one by one"
    measured = f"{1 / fast:.0f} against {1 / slow:.0f} per second: {slow / fast:.0f}x"
    return Row(what, ">= 20000", measured, fast <= 5e-5, {"seconds": fast, "highs_seconds": slow})


def random_contacts(
    count: int, generator: torch.Generator, lean: float = 0.45, fingertips: int = 3
) -> Contacts:
    """Return random contacts with normals that lean away from their centre; the smaller `lean`, the
    more are closed.
    """
    points, noise = (
        torch.randn(count, fingertips, 3, generator=generator, dtype=torch.float64)
        for _ in range(2)
    )
    return Contacts(points, unit(unit(points - points.mean(1, keepdim=True)) + lean * noise))


def border_contacts(
    count: int, fingertips: int, spec: ContactSpec, generator: torch.Generator
) -> Contacts:
    """Return random contacts; the normals of every second one are turned to the border of closure
    and a little on.
    """
    contacts = random_contacts(count, generator, fingertips=fingertips)
    half = count // 2
    points = contacts.points[:half]
    far = contacts.normals[:half]
    near = unit(points - points.mean(1, keepdim=True))
    low = torch.zeros(half, 1, 1, dtype=torch.float64)
    high = torch.full((half, 1, 1), 2.0, dtype=torch.float64)
    for _ in range(45):
        middle = (low + high) / 2
        wrench = wrenches(
            points, unit(near + middle * (far - near)), spec.planned_friction, spec.edges
        )
        closed = (solve_closure_lp(wrench.flatten(1, 2))[0].amin(1) >= MIN_MARGIN)[:, None, None]
        low = torch.where(closed, middle, low)
        high = torch.where(closed, high, middle)
    step = 10 ** (-3 - 7 * torch.rand(half, 1, 1, generator=generator, dtype=torch.float64))
    sign = torch.sign(torch.randn(half, 1, 1, generator=generator, dtype=torch.float64))
    turned = unit(near + (low + sign * step) * (far - near))
    return Contacts(contacts.points, torch.cat([turned, contacts.normals[half:]]))


def has_low_rank(points: np.ndarray, normals: np.ndarray, friction: float, edges: int) -> bool:
    """Tell whether wrenches written anew lack rank, or their largest triangle is flat, to the
    library's thresholds.
    """
    values = np.linalg.svd(
        wrench_matrix(points, normals, friction, edges).astype(float), compute_uv=False
    )
    corners = points[list(combinations(range(len(points)), 3))]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1
    ).max()
    longest = max(((p - q) ** 2).sum() for p, q in combinations(points, 2))
    return bool(values[-1] < 1.001e-3 * values[0] or area < 1.001e-3 * longest)
