"""How much of a load random contacts resist, against HiGHS, with both proofs; and how fast the
margins come.
"""

import numpy as np
import torch
from scipy.optimize import linprog
from tqdm import tqdm

from benchmarks.common import Options, Row, bench, least_seconds
from benchmarks.plan.certificates import random_contacts
from torchgrasp.contacts.form_closure import cone_edges, tangents
from torchgrasp.contacts.resist import resist_loads
from torchgrasp.geometry.linalg import unit
from torchgrasp.values.planning import Contacts
from torchgrasp.values.specs import ContactSpec

FRICTIONS = (0.2, 0.4, 0.6, 0.8, 1.2)


@bench("plan/wrenches")
def wrenches(o: Options) -> list[Row]:
    """Compare the margins of 3 to 5 contacts under random loads with HiGHS, and check both proofs."""
    return [bench_loads(f, max(o.times(10_005) // 3, 10), o.seed) for f in (3, 4, 5)]


def bench_loads(fingertips: int, count: int, seed: int) -> Row:
    """Compare as many random cases, at several frictions, and time them."""
    generator = torch.Generator().manual_seed(seed)
    differences = list[float]()
    gaps = list[float]()
    zero = 0
    seconds = 0.0
    for friction in FRICTIONS:
        spec = ContactSpec(friction, friction_margin=1.0)
        case = random_case(count // len(FRICTIONS), fingertips, generator)
        found = resist_loads(*case, spec)
        if friction == FRICTIONS[1]:
            seconds = least_seconds(
                lambda case=case, spec=spec: resist_loads(*case, spec), 3
            ) / len(case[0])
        points, normals, strength, loads = case
        matrices = edge_wrenches(points, normals, spec)
        for k in tqdm(range(len(points)), desc=f"{fingertips} contacts", disable=None, leave=False):
            margin = float(found.margin[k])
            bound = strength[k].numpy()
            differences.append(abs(margin - by_highs(matrices[k], bound, loads[k, 0].numpy())))
            power = (matrices[k] @ about_origin(found.twist[k], points[k]).numpy()).max(1).clip(0)
            gaps.append(abs(float(bound @ power) - margin))
            zero += margin == 0
    worst = max(differences)
    gap = max(gaps)
    what = f"loads that {fingertips} random contacts resist, {len(differences)} cases at {len(FRICTIONS)} frictions"
    measured = f"largest difference from HiGHS {worst:.1e}, of the dual's bound {gap:.1e}; {zero} resist nothing; "
    measured += f"{1e6 * seconds:.0f} us a load"
    numbers = {"difference": worst, "gap": gap, "seconds": seconds}
    return Row(what, "differences <= 1e-7", measured, max(worst, gap) <= 1e-7, numbers)


def random_case(
    count: int, fingertips: int, generator: torch.Generator
) -> tuple[torch.Tensor, ...]:
    """Return points [m] and normals of random contacts, strengths [N], and one load of each about
    the origin.
    """

    def randn(*size: int) -> torch.Tensor:
        return torch.randn(count, *size, generator=generator, dtype=torch.float64)

    contacts: Contacts = random_contacts(count, generator, fingertips=fingertips)
    points = 0.05 * contacts.points
    strength = 2 + 13 * torch.rand(count, fingertips, generator=generator, dtype=torch.float64)
    force = 5 * unit(randn(3))
    arm = points.mean(1) + 0.03 * randn(3)
    loads = torch.cat([force, torch.linalg.cross(arm, force)], -1)
    return points, contacts.normals, strength, loads[:, None]


def edge_wrenches(points: torch.Tensor, normals: torch.Tensor, spec: ContactSpec) -> np.ndarray:
    """Return the wrenches (b, f, e, 6) about the origin of forces along cone edges, with normal
    parts of 1 N.
    """
    edges = cone_edges(normals, tangents(points, normals), spec.planned_friction, spec.edges)
    return torch.cat(
        [edges, torch.linalg.cross(points[:, :, None].expand_as(edges), edges)], -1
    ).numpy()


def about_origin(twist: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Return a twist about the contacts' centroid as one about the origin."""
    velocity, turn = twist.split(3)
    return torch.cat([velocity - torch.linalg.cross(turn, points.mean(0)), turn])


def by_highs(matrix: np.ndarray, strength: np.ndarray, load: np.ndarray) -> float:
    """Return the greatest multiple of a load that is resisted, by HiGHS with its least tolerances."""
    f, e, _ = matrix.shape
    most = np.zeros((f, f * e + 1))
    most[np.arange(f * e) // e, np.arange(f * e)] = 1
    strict = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    found = linprog(
        np.r_[np.zeros(f * e), -1.0],
        most,
        strength,
        np.c_[matrix.reshape(-1, 6).T, load],
        np.zeros(6),
        method="highs",
        options=strict,
    )
    return -float(found.fun)
