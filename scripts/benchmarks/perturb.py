"""Household perturbations: errors of what a robot knows of an object on a table, one factor at a
time or all together.

The simulator has the true mesh, mass and friction. The planner gets a cloud and a table with
errors. The amount of an error is fixed and its direction is random; friction, depth noise and the
object's pose are random altogether. The random numbers of one factor do not depend on the other
factors.
"""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.evaluation.protocols import POSE_NOISE, PoseNoise, seed_of
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import rigid, rotation_from_vector
from torchgrasp.geometry.linalg import unit
from torchgrasp.geometry.plane import Plane, move
from torchgrasp.values.planning import PointCloud
from torchgrasp.values.specs import TrialSpec

DENSITY = 500.0
"""Density [kg/m^3] of objects of unknown mass: half full, hollow, or of wood."""

BESIDE = 0.02
"""Largest distance [m] from the object's points at which a wrong mask shows the table."""


@dataclasses.dataclass(frozen=True)
class Perturbation:
    """The errors of one factor or of several; the default has none.

    Args:
        mass: whether the object has its own mass (`household_mass`) instead of the trial's.
        friction: range of the true friction, unknown to the planner; None: the trial's friction.
        table: error of the table's height [m], up or down.
        up: error of the table's normal [rad], about the point below the cloud.
        camera: errors of the camera's pose: translation [m], and rotation [rad] about the camera.
        mask: share of the cloud's points on the table, and share of the object's points lost at its
            rim.
        depth: standard deviation of additional noise along the camera's rays [m].
        pose: of the object, which moves after the image was taken.
    """

    mass: bool = False
    friction: tuple[float, float] | None = None
    table: float = 0.0
    up: float = 0.0
    camera: tuple[float, float] = (0.0, 0.0)
    mask: float = 0.0
    depth: float = 0.0
    pose: PoseNoise = dataclasses.field(default_factory=PoseNoise)


_EACH = {
    "mass": {"mass": True},
    "friction": {"friction": (0.4, 1.0)},
    "table": {"table": 0.003},
    "up": {"up": math.radians(2)},
    "camera": {"camera": (0.003, math.radians(1))},
    "mask": {"mask": 0.05},
    "depth": {"depth": 0.001},
    "pose": {"pose": POSE_NOISE},
}
"""The factors: a calibration by hand, a segmentation wrong by a few pixels, and a cheap depth
camera.
"""

PERTURBATIONS = {
    "none": Perturbation(),
    **{name: Perturbation(**fields) for name, fields in _EACH.items()},
    "all": Perturbation(
        **{name: value for fields in _EACH.values() for name, value in fields.items()}
    ),
}
"""By name: nothing, one factor at a time, and all together."""


def find_perturbation(name: str) -> Perturbation:
    """Return a perturbation by its name; an unknown name raises `BadArgument`."""
    if name not in PERTURBATIONS:
        raise BadArgument("perturbation", repr(name), f"one of {', '.join(PERTURBATIONS)}")
    return PERTURBATIONS[name]


def household_mass(volume: float, known: float | None = None) -> float:
    """Return the mass [kg] of an object: the known one, or `DENSITY` times its volume [m^3], from
    0.05 to 1.2 kg.
    """
    return known if known is not None else min(max(DENSITY * volume, 0.05), 1.2)


def perturb_trial(spec: TrialSpec, perturbation: Perturbation, mass: float, seed: int) -> TrialSpec:
    """Return a trial with the true mass [kg] and a random friction, where the perturbation says so."""
    changes = {"mass": mass, "density": None} if perturbation.mass else {}
    if perturbation.friction is not None:
        low, high = perturbation.friction
        share = float(torch.rand((), generator=_generator(seed, "friction"), dtype=torch.float64))
        changes["friction"] = low + (high - low) * share
    return dataclasses.replace(spec, **changes)


def perturb_view(
    cloud: PointCloud, perturbation: Perturbation, seed: int
) -> tuple[PointCloud, Plane]:
    """Return the cloud and the table that a planner gets of an object on the table z = 0.

    A cloud without a viewpoint raises `BadArgument` where the mask, the depth or the camera has
    errors.
    """
    device = cloud.points.device
    here = cloud.to("cpu")
    table = _perturb_table(here, perturbation, seed).to(device)
    points = here.points.double()
    if not (perturbation.mask or perturbation.depth or any(perturbation.camera)):
        return cloud, table
    if here.viewpoint is None:
        raise BadArgument(
            "cloud", "no viewpoint", "a viewpoint, where the camera or its image has errors"
        )
    viewpoint = here.viewpoint.double()
    if perturbation.mask:
        kept = ~find_rim(points, viewpoint, round(perturbation.mask * len(points)), seed)
        count = round(perturbation.mask / (1 - perturbation.mask) * int(kept.sum()))
        points = torch.cat([points[kept], table_beside(points, viewpoint, count, seed)])
    if perturbation.depth:
        noise = torch.randn(
            len(points), 1, generator=_generator(seed, "depth"), dtype=torch.float64
        )
        points = points + perturbation.depth * noise * unit(points - viewpoint)
    seen = PointCloud(points.to(here.points), None, here.viewpoint, here.frustum)
    return move(seen, _camera_error(viewpoint, perturbation.camera, seed)).to(device), table


def find_rim(
    points: Float[Tensor, "n 3"], viewpoint: Float[Tensor, "3"], count: int, seed: int
) -> Bool[Tensor, " n"]:
    """Choose `count` points at the rim of an image: random corners of the outline, then the points
    nearest to it.

    The outline is the border of the triangulated image without its long edges.
    """
    from scipy.spatial import Delaunay, KDTree

    pixels = _image(points, points, viewpoint).numpy()
    triangles = torch.from_numpy(Delaunay(pixels).simplices).long()
    edges = (
        torch.cat([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]).sort(1).values
    )
    image = torch.from_numpy(pixels)
    length = torch.linalg.vector_norm(image[edges[:, 0]] - image[edges[:, 1]], dim=1).reshape(3, -1)
    inside = length.amax(0) <= 3.0 * length.median()
    found, sides = torch.unique(
        edges.reshape(3, -1, 2)[:, inside].flatten(0, 1), dim=0, return_counts=True
    )
    outline = torch.unique(found[sides == 1])
    distance = torch.from_numpy(KDTree(pixels[outline.numpy()]).query(pixels)[0])
    order = torch.randperm(len(points), generator=_generator(seed, "rim"))
    chosen = order[distance[order].argsort(stable=True)[:count]]
    return torch.zeros(len(points), dtype=torch.bool).index_fill(0, chosen, True)


def table_beside(
    points: Float[Tensor, "n 3"], viewpoint: Float[Tensor, "3"], count: int, seed: int
) -> Float[Tensor, "k 3"]:
    """Return random points of the table z = 0 that a wrong mask adds to an object's points.

    Each point lies within `BESIDE` of a point of the object, seen from above, and the camera sees
    it beside the object.
    """
    from scipy.spatial import KDTree

    generator = _generator(seed, "table points")
    pixels = KDTree(_image(points, points, viewpoint).numpy())
    spacing = float(torch.from_numpy(pixels.query(pixels.data, k=2)[0][:, 1]).median())
    found = torch.empty(0, 3, dtype=torch.float64)
    for _ in range(100):
        row = torch.randint(len(points), (8 * count,), generator=generator)
        turn, share = torch.rand(2, 8 * count, generator=generator, dtype=torch.float64)
        shift = torch.stack([(2 * math.pi * turn).cos(), (2 * math.pi * turn).sin()], 1)
        drawn = points[row, :2] + BESIDE * share.sqrt()[:, None] * shift
        drawn = torch.cat([drawn, torch.zeros(8 * count, 1, dtype=torch.float64)], 1)
        beyond = (
            torch.from_numpy(pixels.query(_image(drawn, points, viewpoint).numpy())[0])
            > 3.0 * spacing
        )
        found = torch.cat([found, drawn[beyond]])[:count]
        if len(found) == count:
            return found
    raise BadArgument(
        "cloud",
        f"{len(found)} points of the table beside it in view",
        f"{count}, as of a table z = 0",
    )


def _image(
    points: Float[Tensor, "n 3"], seen: Float[Tensor, "m 3"], viewpoint: Float[Tensor, "3"]
) -> Float[Tensor, "n 2"]:
    """Return the image coordinates of points for a camera that looks at the middle of the seen
    points.
    """
    forward = unit((seen.amin(0) + seen.amax(0)) / 2 - viewpoint)
    across = torch.linalg.svd(forward[None]).Vh[1:]
    return ((points - viewpoint) @ across.T) / ((points - viewpoint) @ forward)[:, None]


def _perturb_table(cloud: PointCloud, perturbation: Perturbation, seed: int) -> Plane:
    """Return a table with an error of height, tilted about the point below the cloud."""
    if not (perturbation.table or perturbation.up):
        return Plane.horizontal(0.0)
    sign = -1.0 if float(torch.rand((), generator=_generator(seed, "table"))) < 0.5 else 1.0
    foot = cloud.points.double().mean(0) * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    foot[2] = sign * perturbation.table
    azimuth = (
        2 * math.pi * float(torch.rand((), generator=_generator(seed, "up"), dtype=torch.float64))
    )
    lean = math.sin(perturbation.up)
    normal = [lean * math.cos(azimuth), lean * math.sin(azimuth), math.cos(perturbation.up)]
    up = torch.tensor(normal, dtype=torch.float64)
    return Plane(up, float(up @ foot))


def _camera_error(
    viewpoint: Float[Tensor, "3"], amounts: tuple[float, float], seed: int
) -> Float[Tensor, "4 4"]:
    """Return the motion of all points for a camera that is rotated and translated."""
    direction, axis = unit(
        torch.randn(2, 3, generator=_generator(seed, "camera"), dtype=torch.float64)
    )
    rotation = rotation_from_vector(amounts[1] * axis)
    return rigid(rotation, viewpoint - rotation @ viewpoint + amounts[0] * direction)


def _generator(seed: int, factor: str) -> torch.Generator:
    """Return the generator of one factor."""
    return torch.Generator().manual_seed(seed_of(seed, factor))
