"""Builders that several tests share: small clouds, meshes, shapes and contacts."""

import functools
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from scipy.optimize import linprog
from torch import Tensor

from torchgrasp import Scene
from torchgrasp.cloud.camera import INTRINSICS, look_at, partial_view, render_depth
from torchgrasp.contacts.form_closure import closed_exact
from torchgrasp.foundation.base import named_tensors
from torchgrasp.geometry.frames import apply, rigid, rotate, rotation_from_vector
from torchgrasp.geometry.linalg import unit
from torchgrasp.geometry.signed_distance import SignedDistanceField, field_from_surface
from torchgrasp.hand import load
from torchgrasp.hand.hand import Hand
from torchgrasp.posture_model.sample import HandSamples
from torchgrasp.shape.estimate import Normalisation, Observations
from torchgrasp.shape.fit import condition
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.kernel import Kernel, KernelName, Profile, cross_covariance
from torchgrasp.values.planning import Contacts, PointCloud

ROOT = Path(__file__).parents[1]


load_hand = functools.cache(load.load_hand)
"""Each hand is read once; it keeps its library of postures."""


def start_process(command: list[str], **options: Any) -> subprocess.Popen[str]:
    """Start a process that SIGINT reaches: children inherit that a shell's background processes
    ignore it.
    """
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, **options)
    finally:
        signal.signal(signal.SIGINT, before)


def real(values) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def directions(n: int, seed: int = 0) -> Tensor:
    """Random unit vectors (n, 3) in float64."""
    return unit(
        torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    )


def random_motion(seed: int) -> Tensor:
    """A rigid motion far from the identity."""
    draw = torch.randn(2, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return rigid(rotation_from_vector(2 * draw[0]), 0.5 * draw[1])


def distance_field(distance, middle: Tensor, half: float, spacing: float) -> SignedDistanceField:
    """The field of a distance in closed form, which takes points (n, n, n, 3), around a middle."""
    axis = torch.arange(-half, half, spacing, dtype=torch.float64)
    offsets = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return SignedDistanceField(middle - half, spacing, distance(offsets + middle))


def spokes(*angles: float) -> Tensor:
    """Unit vectors (1, f, 3) across z at angles [rad]; by default the corners of a triangle."""
    turn = real(angles or (0.1, 2.2, 4.3))
    return torch.stack([turn.cos(), turn.sin(), torch.zeros_like(turn)], -1)[None]


def ball(
    n: int = 300, radius: float = 0.04, centre=(0.0, 0.0, 0.0), seed: int = 0, viewpoint=None
) -> PointCloud:
    """Points all around a ball, with outward normals."""
    normals = directions(n, seed)
    return PointCloud(radius * normals + real(centre), normals, viewpoint)


def ball_contacts(
    n: int, generator: torch.Generator, fingertips: int = 3, radius: float = 0.04
) -> Contacts:
    """Random contacts on a ball, some closed, some not."""
    normals = unit(torch.randn(n, fingertips, 3, generator=generator, dtype=torch.float64))
    return Contacts(radius * normals, normals)


def box(size, place=(0.0, 0.0)) -> trimesh.Trimesh:
    """A box with its centre at a place (x, y, z), or standing on z = 0 at (x, y)."""
    return trimesh.creation.box(size).apply_translation([*place, size[2] / 2][:3])


CUP_RADIUS = 0.037
CUP_HEIGHT = 0.075


@functools.cache
def cup(wall: float, radius: float = CUP_RADIUS, floor: float = 0.003) -> trimesh.Trimesh:
    """A straight cup that stands at z = 0, open at the top."""
    inside = radius - wall
    profile = [
        [0, 0],
        [radius, 0],
        [radius, CUP_HEIGHT],
        [inside, CUP_HEIGHT],
        [inside, floor],
        [0, floor],
    ]
    return trimesh.creation.revolve(np.array(profile), sections=96)


@functools.cache
def cup_view(wall: float, elevation: float = 35.0, seed: int = 0, noise: bool = True) -> PointCloud:
    """The view of a cup from a camera 0.5 m away."""
    mesh = cup(wall)
    return partial_view(mesh, look_at(20.0, elevation, target=mesh), n=1000, noise=noise, seed=seed)


def cylinder_points(radius: float, low: float, high: float) -> tuple[Tensor, Tensor]:
    """Points all around a vertical cylinder, and its outward normals."""
    angle = torch.arange(24, dtype=torch.float64) * (2 * torch.pi / 24)
    out = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], 1)
    heights = torch.linspace(low, high, 6, dtype=torch.float64)
    points = radius * out + heights[:, None, None] * real([0.0, 0.0, 1.0])
    return points.flatten(0, 1), out.expand(6, -1, -1).flatten(0, 1)


def write_objects(folder: Path) -> Path:
    """Six convex objects as NAME/mesh.ply, standing at z = 0."""
    shapes = {
        "brick": trimesh.creation.box([0.05, 0.07, 0.09]),
        "cube": trimesh.creation.box([0.05, 0.05, 0.05]),
        "tin": trimesh.creation.cylinder(radius=0.03, height=0.09),
        "disc": trimesh.creation.cylinder(radius=0.045, height=0.03),
        "ball": trimesh.creation.icosphere(subdivisions=2, radius=0.03),
        "slab": trimesh.creation.box([0.10, 0.06, 0.03]),
    }
    for name, mesh in shapes.items():
        mesh.apply_translation([0, 0, -mesh.bounds[0, 2]])
        (folder / name).mkdir(parents=True)
        mesh.export(folder / name / "mesh.ply")
    return folder


def field_of_mesh(mesh: trimesh.Trimesh, margin: float = 0.08) -> SignedDistanceField:
    """The signed distance field of a mesh [m]."""
    vertices = torch.tensor(np.asarray(mesh.vertices))
    faces = torch.tensor(np.asarray(mesh.faces))
    return field_from_surface(vertices, faces, margin=margin)


HALF_BALL_RADIUS = 0.04


def half_ball(seen_from: float, std_factor: float, noise: float = 0.02) -> ShapeGP:
    """The shape of a ball whose part above `seen_from` (in radii) was seen."""
    generator = torch.Generator().manual_seed(0)
    n = unit(torch.randn(120, 3, generator=generator, dtype=torch.float64))
    n = n[n[:, 2] > seen_from]
    outside = 1.2 * unit(torch.randn(40, 3, generator=generator)).double()
    x = torch.cat([n, torch.zeros(1, 3, dtype=torch.float64), outside])
    distance = torch.cat(
        [torch.zeros(len(n)), torch.tensor([-1.0]), torch.full((40,), 0.2)]
    ).double()
    oriented = torch.arange(len(x)) < len(n)
    sigma = torch.full_like(distance, noise)
    observations = Observations(
        x, distance, torch.cat([n, torch.zeros_like(x[len(n) :])]), oriented, sigma, sigma
    )
    normalisation = Normalisation(torch.zeros(3, dtype=torch.float64), HALF_BALL_RADIUS)
    return condition(
        observations, normalisation, PointCloud(HALF_BALL_RADIUS * n, n), std_factor=std_factor
    )


def contacts_on(
    shape: ShapeGP, generator: torch.Generator, count: int, fingertips: int = 3
) -> Contacts:
    """Random contacts on the mean surface with its normals, closed at friction 0.8."""
    x = unit(torch.randn(20 * count, fingertips, 3, generator=generator, dtype=torch.float64))
    for _ in range(8):
        distance, slope = (
            t.unflatten(0, (len(x), -1)) for t in shape.mean_and_gradient(x.flatten(0, 1))
        )
        x = x - (distance / (slope * slope).sum(-1))[..., None] * slope
    normals = unit(shape.mean_and_gradient(x.flatten(0, 1))[1]).unflatten(0, (len(x), -1))
    good = closed_exact(x, normals, 0.8) & (
        torch.linalg.vector_norm(x - x.roll(1, 1), dim=-1).amin(-1) > 0.3
    )
    x = x[good][:count]
    normals = normals[good][:count]
    return Contacts(shape.metres(x), normals)


def touched_contacts(hand: Hand, joints: Tensor, obj_from_hand: Tensor | None = None) -> Contacts:
    """Contacts at the middle of the fingertips' pads, in the hand's frame or at poses of the hand."""
    points, normals = hand.fingertips(joints)
    if obj_from_hand is not None:
        points = apply(obj_from_hand, points)
        normals = rotate(obj_from_hand, normals)
    return Contacts(points, -normals)


def ring_samples(n: int = 3000) -> HandSamples:
    """Postures of one joint that goes round, and a code that follows it."""
    rng = np.random.default_rng(7)
    angle = rng.uniform(0, 6, size=n)
    lengths = 0.05 + 0.01 * np.stack([np.sin(angle), np.cos(angle), np.sin(2 * angle)], -1)
    cosines = np.stack([np.cos(angle), np.sin(angle), np.cos(3 * angle)], -1)
    q = np.concatenate([lengths, cosines], -1) + rng.normal(size=(n, 6)) * np.repeat(
        [1e-3, 0.05], 3
    )
    return HandSamples(torch.from_numpy(angle[:, None]), torch.from_numpy(q), ("turn",))


def covariance(
    x: Tensor, other: Tensor, has_normal: Tensor, other_has_normal: Tensor, profile: Profile
) -> Tensor:
    """The covariance of observations by autograd, Eqs. (2)-(5): all d, then w1, w2, w3 of points
    with normals.
    """
    blocks = cross_covariance(Kernel(profile), x.detach(), other.detach(), len(other)).flatten(0, 1)
    rows, columns = (
        torch.cat([torch.ones_like(mask), mask.repeat(3)])
        for mask in (has_normal, other_has_normal)
    )
    return blocks[rows][:, columns]


def dense_posterior(
    known: Observations,
    profile: Profile,
    x: Tensor,
    normals: bool = True,
    extra: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Mean and covariance of (d, w), or of d alone, at points by one dense solve; `extra` is added
    to the noise.
    """
    y, noise = known.rows()
    has = known.has_normal
    asked = torch.full((len(x),), normals)
    k = (
        covariance(known.x, known.x, has, has, profile)
        + torch.diag(noise)
        + (0.0 if extra is None else extra)
    )
    star = covariance(x, known.x, asked, has, profile)
    own = covariance(x, x, asked, asked, profile)
    return star @ torch.linalg.solve(k, y), own - star @ torch.linalg.solve(k, star.T)


def half_sphere(n: int = 40, extra: int = 0) -> Observations:
    """Points of the unit sphere's right half with normals, mixed with points off it without; then
    `extra` on it.
    """
    generator = torch.Generator().manual_seed(3)
    on = unit(torch.randn(n + extra, 3, dtype=torch.float64, generator=generator))
    on = torch.cat([on[:, :1].abs(), on[:, 1:]], 1)
    x = torch.cat([real([[0.0, 0.0, 0.0]]), -1.2 * on[:10], 1.2 * on[:10], on])
    last = len(x) - extra
    x = torch.cat([x[torch.randperm(last, generator=generator)], x[last:]])
    distance = torch.linalg.vector_norm(x, dim=-1) - 1.0
    on_sphere = distance.abs() < 1e-9
    noise = torch.full_like(distance, 0.02)
    return Observations(x, torch.where(on_sphere, 0.0, distance), x, on_sphere, noise, 2.5 * noise)


def fit_half_sphere(
    known: Observations, kernel: KernelName | Kernel = "thin_plate", std_factor: float = 1.0
) -> ShapeGP:
    """The shape of observations of the unit sphere, as a ball of 50 mm at an offset."""
    frame = Normalisation(real([0.3, -0.2, 0.1]), 0.05)
    cloud = PointCloud(frame.metres(known.x[known.has_normal]))
    return condition(known, frame, cloud, std_factor=std_factor, kernel=kernel)


def queries(shape: ShapeGP, n: int) -> Tensor:
    """Points [m] all over a shape's domain."""
    generator = torch.Generator().manual_seed(7)
    x = unit(torch.randn(n, 3, dtype=torch.float64, generator=generator))
    return shape.metres(
        x * torch.rand(n, 1, dtype=torch.float64, generator=generator) * shape.domain_radius * 0.99
    )


def near(found: Tensor, wanted: Tensor, atol: float) -> None:
    """Assert that all numbers are within a tolerance of the wanted ones."""
    torch.testing.assert_close(found, wanted, rtol=0, atol=atol)


def same_bits(first: Any, second: Any) -> bool:
    """Tell whether two values hold the same tensors to the last bit."""
    a = named_tensors(first)
    b = named_tensors(second)
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def largest_share(wrenches: np.ndarray) -> float:
    """The largest s of Eq. (13) by SciPy: phi >= s, sum phi = 1, and phi balances the wrenches (6,
    m).
    """
    m = wrenches.shape[1]
    equal = np.r_[
        np.c_[wrenches, wrenches.sum(1)], [np.r_[np.ones(m), m]]
    ]  # phi = s + psi with psi >= 0
    bounds = [(0, None)] * m + [(None, None)]
    found = linprog(np.r_[np.zeros(m), -1.0], A_eq=equal, b_eq=np.eye(7)[6], bounds=bounds)
    return float(found.x[m]) if found.status == 0 else -np.inf


def closure_margin(
    points: Tensor, normals: Tensor, friction: float, edges: int = 24
) -> tuple[float, int]:
    """The margin of Eq. (13) for contacts (f, 3) by NumPy and SciPy alone, and the rank of their
    wrenches.
    """
    arms = (points - points.mean(0)).numpy()
    columns = []
    turn = 2 * np.pi * np.arange(edges)[:, None] / edges
    for arm, inward in zip(
        arms / np.linalg.norm(arms, axis=1).max(), -normals.numpy(), strict=True
    ):
        one, other = np.linalg.svd(inward[None])[2][1:]
        force = inward + friction * (np.cos(turn) * one + np.sin(turn) * other)
        columns.append(np.c_[force, np.cross(arm, force)])
    wrenches = np.concatenate(columns).T
    return largest_share(wrenches), int(np.linalg.matrix_rank(wrenches, tol=1e-3))


def run_python(*arguments: str, given: str = "") -> subprocess.CompletedProcess[str]:
    """Run Python in a process of its own that can import the library and the helpers of the tests,
    `given` a text.
    """
    path = os.pathsep.join(
        filter(None, [str(ROOT), str(ROOT / "scripts"), os.environ.get("PYTHONPATH")])
    )
    environment = os.environ | {"PYTHONPATH": path}
    command = [sys.executable, *arguments]
    return subprocess.run(
        command, input=given, capture_output=True, text=True, timeout=600, env=environment
    )


HALF = INTRINSICS.clone()
"""Intrinsics (3, 3) of the default camera whose every second row and column is kept."""
HALF[:2] /= 2


def halved(image: Tensor) -> Tensor:
    """Return every second row and column of an image (h, w), which `HALF` describes."""
    return image[::2, ::2].contiguous()


@functools.cache
def see(*boxes: tuple[float, ...], pose: Tensor | None = None, half: bool = True) -> Scene:
    """Return the scene of boxes (x, y, width, height) on the table, or (x, y, width, height, foot),
    at half resolution or in full.
    """
    meshes = []
    for x, y, width, height, *foot in boxes:
        mesh = trimesh.creation.box([width, width, height])
        mesh.apply_translation([x, y, height / 2 + (foot[0] if foot else 0.0)])
        meshes.append(mesh)
    camera = look_at(20.0, 45.0, 0.7)
    depth, labels = render_depth(meshes, camera)
    intrinsics = INTRINSICS
    if half:
        depth, labels, intrinsics = halved(depth), halved(labels), HALF
    return Scene.from_depth(
        depth, intrinsics, camera if pose is None else pose @ camera, labels=labels
    )
