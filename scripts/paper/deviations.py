"""What docs/paper.md says of the paper's equations, measured: where they fail as written, and how
often.
"""

import dataclasses
import itertools
import statistics
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
import trimesh
from torch import Tensor

from paper.trials import most_certain_first
from torchgrasp import (
    ClosingReference,
    Contacts,
    ContactSpec,
    PointCloud,
    ShapeGP,
    Status,
    certify,
    close_hand,
    cloud_from_depth,
    fit_shape,
    list_objects,
    load_hand,
    load_object,
    plan_contacts,
)
from torchgrasp.cloud.camera import INTRINSICS, look_at, render_depth
from torchgrasp.control.controller import CLOSING_TIME
from torchgrasp.control.law import blend
from torchgrasp.control.paper.stability import load_stability
from torchgrasp.data.shipped import GRASPED, load_shipped_grasp
from torchgrasp.evaluation import PROTOCOLS
from torchgrasp.evaluation.protocols import draw_error, seed_of
from torchgrasp.files import format_json, write_file
from torchgrasp.foundation.errors import IndefiniteCovariance
from torchgrasp.posture_model.mixture import PAPER_ENERGY, encode, load_mixture, mixture_path
from torchgrasp.shape.conditioning import longest_distance
from torchgrasp.shape.kernel import gram, thin_plate_kernel

HANDS = ("allegro", "barrett")
PAPER = PROTOCOLS["paper"]
POINTS = 1000
"""Points of a cloud, as in the paper."""


def deviations(
    out: Path, views: int = 25, starts: int = 300, draws: int = 3, lifts: int = 6
) -> None:
    """Print how often each equation of the paper fails as written: the figures of docs/paper.md.

    Args:
        out: folder of deviations.json; it is made where it does not exist.
        views: noisy clouds of each of the library's objects, from directions all round.
        starts: of the contact planner.
        draws: of the starts and of the paper's outer points.
        lifts: of each shipped grasp under closing "paper", each with an error of the object's pose.
    """
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    asked = {"views": views, "starts": starts, "draws": draws, "lifts": lifts}
    found: dict[str, Any] = {}
    for name, value in itertools.chain(
        of_closings(), of_equations(), of_lifts(lifts), of_plans(starts, draws), of_shapes(views)
    ):
        found[name] = value
        print(f"{name}: {value}", flush=True)
    write_file(out / "deviations.json", format_json(asked | {"found": found}))


def of_closings() -> Iterator[tuple[str, str]]:
    """Yield how the printed Sigma_cov differs from the one of the closing "uncertainty", on the
    shipped grasps.
    """
    floored = 0
    entries = 0
    shares = []
    loose = []
    moved = []
    deviation = []
    for name, hand in sorted(GRASPED):
        plan = ClosingReference.from_grasp(load_hand(hand), load_shipped_grasp(name, hand))
        printed = plan.as_printed().gains.covariance
        error = -0.005 * plan.normals
        diagonal = printed.diagonal(dim1=-2, dim2=-1)
        floored = floored + int((diagonal < 1.01e-8).sum())
        entries = entries + diagonal.numel()
        shares.append(torch.stack([blend(error, printed), blend(error, plan.gains.covariance)]))
        model = load_stability(plan.hand)
        assert model is not None
        tips = plan.gains.target + plan.hand.tips.radius[:, None] * plan.normals
        wanted = model.preferred_forces(tips, 4.0).forces
        free = model.preferred_forces(tips)
        led = ClosingReference.from_grasp(
            plan.hand, load_shipped_grasp(name, hand), 4.0, stability=model
        )
        loose.append(
            float(torch.linalg.vector_norm((wanted[:, None] * plan.normals).sum(0)) / wanted.sum())
        )
        moved.append(float((-(led.gains.desired_force * led.normals).sum(-1) - wanted).abs().max()))
        deviation += free.covariance.diagonal().sqrt().tolist()
    printed, ours = torch.cat(shares, 1)
    yield (
        "f_d, the model's normal forces alone: what is unbalanced",
        f"{min(loose):.0%} to {max(loose):.0%} of their sum",
    )
    yield (
        "f_d, balanced: largest change of a normal force",
        f"{min(moved):.1f} to {max(moved):.1f} N of 4 N",
    )
    yield (
        "Sigma_fd, deviation of the model's forces",
        f"{min(deviation):.2f} to {max(deviation):.2f} N, beside 0.3 N",
    )
    yield "Eqs. (26), (27), entries of Sigma_cov that are replaced", f"{floored} of {entries}"
    ends = [f"{float(x.min()):.2f} to {float(x.max()):.2f}" for x in (printed, ours)]
    yield (
        "Eq. (26), lambda 5 mm before a contact",
        f"{ends[0]} as printed, {ends[1]} with n n^T s^2 + floor^2 I",
    )


def of_equations() -> Iterator[tuple[str, str]]:
    """Yield what Eqs. (5), (13) and (18) give for points made up for them."""
    x = torch.randn(6, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    written = as_written(x, longest_distance(x))
    skew = float((written - written.T).abs().max() / written.abs().max())
    least = float(torch.linalg.eigvalsh(0.5 * (written + written.T))[0])
    yield (
        "Eqs. (4), (5), both derivatives by x^i",
        f"asymmetry {skew:.2f} of the largest entry, eigenvalue {least:.0f}",
    )
    points = torch.tensor(
        [[-0.03, 0.0, 0.0], [0.03, 0.0, 0.0], [0.03, 0.0, 0.0]], dtype=torch.float64
    )
    normals = torch.tensor(
        [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64
    )
    line = certify(Contacts(points[None], normals[None]), ContactSpec.paper())
    yield (
        "Eq. (13), contacts on a line",
        f"margin {float(line.margin):.3f}, singular values' ratio {float(line.rank_ratio):.0e}",
    )
    points = 0.03 * x[:3]
    normals = torch.nn.functional.normalize(x[3:], dim=-1)
    mirror = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    code, other = (
        encode(Contacts((m * points)[None], (m * normals)[None])).q for m in (1.0, mirror)
    )
    yield (
        "Eq. (18), code of the mirrored contacts",
        f"differs by {float((code - other).abs().max()):.0e}",
    )


def of_lifts(count: int) -> Iterator[tuple[str, str]]:
    """Yield how the printed law closes and lifts the shipped grasps, under errors of the object's
    pose.
    """
    results = []
    first = 0
    for name, hand_name in sorted(GRASPED):
        thing = load_object(name)
        hand = load_hand(hand_name)
        grasp = load_shipped_grasp(name, hand_name)
        spec = dataclasses.replace(
            PAPER.trial, closing="paper", holding="impedance", mass=thing.mass
        )
        for draw in range(count):
            error = draw_error(PAPER, grasp, thing.mesh, seed_of(0, name, draw))
            found = close_hand(
                grasp, hand, thing.mesh, spec, draw + 1, parts=thing.parts, error=error
            )
            results.append(found)
            first += most_certain_first(found.contact_order, grasp)
    closing = [float(x.phases[1] - x.phases[0]) for x in results]
    pushed = statistics.median(1e3 * x.pushed.distance for x in results)
    held = sum(x.held for x in results)
    early = sum(time < CLOSING_TIME - 0.05 for time in closing)
    yield "closing 'paper', holding 'impedance', shipped grasps held", f"{held} of {len(results)}"
    yield (
        "the most certain finger first; median push; closed by itself",
        f"{first}; {pushed:.1f} mm; {early} within {CLOSING_TIME:g} s",
    )


def as_written(x: Tensor, psi: float) -> Tensor:
    """Return the covariance of distances and normals at points (n, 3), with every derivative by the
    first point.
    """
    i, j = (
        part.reshape(-1, 3)
        for part in (x[:, None].expand(-1, len(x), 3), x[None].expand(len(x), -1, 3))
    )
    d = i - j
    r = torch.linalg.vector_norm(d, dim=-1)
    k, first, second = thin_plate_kernel(psi).derivatives(r, 3)
    block = torch.zeros(len(r), 4, 4).to(x)
    block[:, 0, 0] = k
    block[:, 1:, 0] = block[:, 0, 1:] = first[:, None] * d
    block[:, 1:, 1:] = (
        first[:, None, None] * torch.eye(3).to(x)
        + second[:, None, None] * d[:, :, None] * d[:, None, :]
    )
    return block.unflatten(0, (len(x), len(x))).permute(0, 2, 1, 3).reshape(4 * len(x), -1)


def of_plans(starts: int, draws: int) -> Iterator[tuple[str, str]]:
    """Yield what becomes of the paper's contacts on the paper's shape of the shipped views, without
    a table.
    """
    beyond = dict.fromkeys(HANDS, 0.0)
    on_a_line = 0
    for name in list_objects():
        accepted: dict[str, list[int]] = {hand: [] for hand in HANDS}
        planned = []
        low = []
        for seed in range(draws):
            shape = fit_shape(load_object(name).view, support="paper", seed=seed)
            plan = plan_contacts(shape, ContactSpec.paper(), starts=starts, seed=seed)
            contacts = plan.contacts[plan.status == Status.OK]
            planned.append(len(contacts))
            low.append(int((contacts.points[..., 2] < 0.0).any(1).sum()))
            code = encode(contacts)
            on_a_line += int((code.status != Status.OK).sum())
            for hand in HANDS:
                loaded = load_hand(hand)
                mixture = load_mixture(mixture_path(loaded.urdf_path.parent))
                fits = mixture.energy(code) < PAPER_ENERGY
                accepted[hand].append(int(fits.any(1).sum()))
                joints = mixture.joints(code)[torch.isfinite(mixture.energy(code))]
                outside = ((joints < loaded.lower) | (joints > loaded.upper)).any(-1)
                beyond[hand] += float(outside.double().mean()) / (draws * len(list_objects()))
        yield f"contacts below the table, {name}", f"{low} of {planned} triples"
        yield f"Eq. (21), triples accepted, {name}", f"{accepted} of {planned}"
    yield "Eq. (17), triples on a line", f"{on_a_line}"
    yield (
        "Eq. (23), means with a joint beyond its limits",
        f"{ {hand: f'{x:.0%}' for hand, x in beyond.items()} }",
    )


def of_shapes(views: int) -> Iterator[tuple[str, str]]:
    """Yield what is said of the shape, over noisy clouds of the library's objects."""
    indefinite = 0
    ours = 0
    refused = 0
    negative = [0, 0]
    far = 0
    lengths = []
    corners = []
    clouds = [see(name, k, views) for name in list_objects() for k in range(views)]
    for k, cloud in enumerate(clouds):
        shape = fit_shape(cloud, support="paper", seed=k)
        kernel = thin_plate_kernel(longest_distance(shape.x))
        noise = 0.01**2  # the variance of all observed numbers
        indefinite += is_indefinite(gram(kernel, shape.x, len(shape.x)), noise)
        ours += is_indefinite(gram(kernel, shape.x, int(shape.has_normal.sum())), noise)
        refused += raises(cloud, k)
        x = shape.normalise(shape.cloud.points.double())
        lengths.append(torch.linalg.vector_norm(shape.mean_and_gradient(x)[1], dim=-1))
        away = torch.nn.functional.normalize(x[::10], dim=-1) * shape.domain_radius
        negative = [
            n + int((shape.estimate(f * away)[1][:, 0, 0] < 0).sum())
            for n, f in zip(negative, (2, 4), strict=True)
        ]
        far += len(away)
        box = (
            (cloud.points.amax(0) + cloud.points.amin(0)) / 2,
            (cloud.points.amax(0) - cloud.points.amin(0)) / 2,
        )
        corners.append(
            float(torch.linalg.vector_norm((cloud.points - box[0]) / box[1], dim=-1).max())
        )
    steep = torch.cat(lengths)
    low, high = (float(steep.quantile(q)) for q in (0.05, 0.95))
    of_all = f"of {len(clouds)} clouds"
    yield (
        "Eq. (6), psi the longest distance, a normal at each point: K + sigma^2 I indefinite",
        f"{indefinite} {of_all}",
    )
    yield (
        "the same with normals on the surface alone",
        f"{ours} {of_all}; `psi_scale=1` raises for {refused}",
    )
    ends = (
        f"{float(steep.min()):.2f} to {float(steep.max()):.1f}, 90 % within {low:.2f} to {high:.1f}"
    )
    yield "Eq. (11), lengths of f_w at the cloud's points", ends
    shares = " and ".join(f"{n / far:.0%}" for n in negative)
    yield "Eq. (8), variance negative at 2 and 4 radii of the domain", f"{shares} of the directions"
    yield (
        "coordinates within [-1, 1], norm of the farthest point",
        f"{min(corners):.2f} to {max(corners):.2f}",
    )


def see(name: str, k: int, views: int) -> PointCloud:
    """Return a noisy cloud of `POINTS` points of an object, from the k-th of some directions all
    round.
    """
    mesh = load_object(name).mesh
    pose = look_at(360.0 * k / views, 20.0 + 10.0 * (k % 5), target=mesh)
    depth, labels = render_depth([trimesh.Trimesh(mesh.vertices, mesh.faces)], pose, seed=k)
    cloud = cloud_from_depth(depth, INTRINSICS, mask=labels == 1, camera_pose=pose)
    rows = torch.randperm(len(cloud), generator=torch.Generator().manual_seed(k))[:POINTS]
    return cloud.select(rows.sort().values)


def is_indefinite(matrix: Tensor, noise: float) -> bool:
    """Tell whether a covariance plus the noise's variance has a negative eigenvalue."""
    return float(torch.linalg.eigvalsh(matrix)[0]) + noise < 0


def raises(cloud: PointCloud, seed: int) -> bool:
    """Tell whether the library refuses the paper's psi for a cloud."""
    try:
        shape: ShapeGP | None = fit_shape(cloud, support="paper", psi_scale=1.0, seed=seed)
    except IndefiniteCovariance:
        shape = None
    return shape is None
