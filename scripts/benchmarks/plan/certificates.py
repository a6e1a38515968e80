"""Certificates of random contacts, many at the border of closure, against rational arithmetic; and their speed."""

from fractions import Fraction
from itertools import combinations

import numpy as np
import torch
from tqdm import tqdm

from benchmarks.common import Options, Row, bench, least_seconds
from benchmarks.plan.exact_lp import exact_margin, proves_margin_above, proves_margin_below, wrench_matrix
from torchgrasp.geometry.linalg import unit
from torchgrasp.plan.certify import certify, solve_by_highs
from torchgrasp.plan.closure import MIN_MARGIN, solve_closure_lp, wrenches
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Contacts

FRICTIONS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.5, 2.0)
EDGES = (8, 8, 8, 8, 8, 3, 4, 5, 6, 12)


@bench("plan/certificates")
def certificates(o: Options) -> list[Row]:
    """Compare certificates of 3 to 5 contacts with exact arithmetic."""
    return [row for f in (3, 4, 5) for row in bench_certificates(f, max(o.times(100_000), 20), o.seed)]


def bench_certificates(fingertips: int, grasps: int, seed: int) -> list[Row]:
    """Certify random contacts, half of them at the border of closure, and prove every verdict in exact arithmetic."""
    generator = torch.Generator().manual_seed(seed)
    each = grasps // len(FRICTIONS)
    counts = {"closed": 0, "open": 0, "degenerate": 0}
    wrong, worst = 0, 0.0
    bound, sampled, aside = Fraction(MIN_MARGIN), 0, 0
    nearest: list[float] = []
    for friction, edges in tqdm(list(zip(FRICTIONS, EDGES, strict=True)), desc="frictions", disable=None, leave=False):
        spec = ContactSpec(friction=friction, edges=edges, friction_margin=1.0)
        contacts = border_contacts(each, fingertips, spec, generator)
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
    contacts = random_contacts(10_000, generator, fingertips=fingertips)
    fast = least_seconds(lambda: certify(contacts, spec)) / len(contacts)
    matrices = wrenches(contacts.points[:100], contacts.normals[:100], 0.5, 8).flatten(1, 2).numpy()
    slow = least_seconds(lambda: [solve_by_highs(m) for m in matrices], 3) / len(matrices)
    return [
        Row(
            f"certificates: {total} rows of {fingertips} contacts at 10 frictions, half within 1e-3 of the border, "
            "in exact arithmetic",
            "0 wrong",
            f"{wrong} wrong ({counts['closed']} closed, {counts['open']} open, {counts['degenerate']} lack rank); "
            f"margins of {sampled} against an exact programme: largest difference {worst:.1e}; {aside} more have "
            "no feasible basis among the coefficients that HiGHS leaves",
            wrong == 0 and worst < 1e-7,
            {"wrong": wrong, "counts": counts, "worst": worst, "aside": aside, "median_from_border": nearest},
        ),
        Row(
            f"certificates of {fingertips} contacts per second, 10^4 at once, one thread, against one HiGHS programme "
            "after the other",
            ">= 20000",
            f"{1 / fast:.0f} against {1 / slow:.0f} per second: {slow / fast:.0f}x",
            fast <= 5e-5,
            {"seconds": fast, "highs_seconds": slow},
        ),
    ]


def random_contacts(count: int, generator: torch.Generator, lean: float = 0.45, fingertips: int = 3) -> Contacts:
    """Return random contacts with normals that lean away from their centre; the smaller `lean`, the more are closed."""
    points, noise = (torch.randn(count, fingertips, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    return Contacts(points, unit(unit(points - points.mean(1, keepdim=True)) + lean * noise))


def border_contacts(count: int, fingertips: int, spec: ContactSpec, generator: torch.Generator) -> Contacts:
    """Return random contacts; the normals of every second one are turned to the border of closure and a little on."""
    contacts = random_contacts(count, generator, fingertips=fingertips)
    half = count // 2
    points, far = contacts.points[:half], contacts.normals[:half]
    near = unit(points - points.mean(1, keepdim=True))
    low, high = torch.zeros(half, 1, 1, dtype=torch.float64), torch.full((half, 1, 1), 2.0, dtype=torch.float64)
    for _ in range(45):
        middle = (low + high) / 2
        wrench = wrenches(points, unit(near + middle * (far - near)), spec.planned_friction, spec.edges)
        closed = (solve_closure_lp(wrench.flatten(1, 2))[0].amin(1) >= MIN_MARGIN)[:, None, None]
        low, high = torch.where(closed, middle, low), torch.where(closed, high, middle)
    step = 10 ** (-3 - 7 * torch.rand(half, 1, 1, generator=generator, dtype=torch.float64))
    sign = torch.sign(torch.randn(half, 1, 1, generator=generator, dtype=torch.float64))
    turned = unit(near + (low + sign * step) * (far - near))
    return Contacts(contacts.points, torch.cat([turned, contacts.normals[half:]]))


def has_low_rank(points: np.ndarray, normals: np.ndarray, friction: float, edges: int) -> bool:
    """Tell whether wrenches written anew lack rank, or their largest triangle is flat, to the library's thresholds."""
    values = np.linalg.svd(wrench_matrix(points, normals, friction, edges).astype(float), compute_uv=False)
    corners = points[list(combinations(range(len(points)), 3))]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1).max()
    longest = max(((p - q) ** 2).sum() for p, q in combinations(points, 2))
    return bool(values[-1] < 1.001e-3 * values[0] or area < 1.001e-3 * longest)
