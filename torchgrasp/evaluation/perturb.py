"""What a robot does not know of a scene: its errors, one by one and all together.

The simulator has the truth: the true mesh on the table z = 0, with its mass and friction. The planner gets a cloud and
a table that are wrong. An amount is met exactly and its direction is drawn, but for friction, depth and the object's
pose. The draws of one factor do not depend on the other factors.
"""

import dataclasses
import math
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value, check_number
from torchgrasp.checks import Positive, Range, Seed, checked
from torchgrasp.errors import BadArgument
from torchgrasp.evaluation.protocols import POSE_NOISE, PoseNoise, seed_of
from torchgrasp.geometry.frames import rigid, rotation_from_vector
from torchgrasp.geometry.linalg import unit
from torchgrasp.geometry.plane import Plane, move
from torchgrasp.specs import TrialSpec
from torchgrasp.values import PointCloud

DENSITY = 500.0
"""Density [kg/m^3] of objects of unknown mass: household objects are half full, or hollow, or of wood."""
MASSES = (0.05, 1.2)
"""Least and largest mass [kg] that `household_mass` gives: what one hand lifts from a table."""
BESIDE = 0.02
"""How far [m] from the object's points a wrong mask finds the table."""
ROUNDS = 100
"""Tries, of eight candidates a point, before the table beside an object counts as out of view."""
MASK_GAP = 3.0
"""How many typical distances of two points in the image a point of the table is beyond the object's, at least."""
LONG_EDGE = 3.0
"""Edges of the triangulated image longer than this many of its median edges lie outside the silhouette."""


Friction = Annotated[float, Range(0.0, 10.0)]
"""A coefficient of friction."""
Tilt = Annotated[float, Range(0.0, math.pi / 4)]
"""An angle [rad] of an error that a robot may have."""


@checked
@dataclasses.dataclass(frozen=True)
class Perturbation(Value):
    """What is wrong or unknown; the default is nothing.

    Args:
        mass: whether the object weighs what it weighs (`household_mass`), not what the trial says.
        friction: ends of the range from which friction is drawn, unknown to the planner; None: that of the trial.
        table: error of the table's height [m], up or down.
        up: error of the table's normal [rad], about the point below the cloud.
        camera: errors of the camera's pose: translation [m], and rotation [rad] about the camera.
        mask: share of the points that show the table, and share of the object's points that its rim loses.
        depth: standard deviation of further noise along the camera's rays [m].
        pose: of the object, which is moved after the camera's look.

    Raises:
        BadArgument: a number outside its range.

    >>> Perturbation(mass=True, friction=(0.4, 1.0)).friction
    (0.4, 1.0)
    """

    mass: bool = False
    friction: tuple[Friction, Friction] | None = None
    table: Annotated[float, Range(0.0, 0.1)] = 0.0
    up: Tilt = 0.0
    camera: tuple[Annotated[float, Range(0.0, 0.1)], Tilt] = (0.0, 0.0)
    mask: Annotated[float, Range(0.0, 0.5)] = 0.0
    depth: Annotated[float, Range(0.0, 0.1)] = 0.0
    pose: PoseNoise = dataclasses.field(default_factory=PoseNoise)

    def __post_init__(self) -> None:
        """Check that the range of friction is one."""
        low, high = self.friction or (0.0, 0.0)
        check_number("friction", high, low, 10.0)


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
"""The factors: calibration by hand, a segmentation that is a few pixels off, and a cheap depth camera."""

PERTURBATIONS = {
    "none": Perturbation(),
    **{name: Perturbation(**fields) for name, fields in _EACH.items()},
    "all": Perturbation(**{name: value for fields in _EACH.values() for name, value in fields.items()}),
}
"""By name: nothing, one factor at a time, and all together."""


@checked
def find_perturbation(perturbation: Perturbation | str) -> Perturbation:
    """Return a perturbation by its name, or as it is.

    Raises:
        BadArgument: an unknown name.

    >>> find_perturbation("table").table
    0.003
    """
    if isinstance(perturbation, Perturbation):
        return perturbation
    if perturbation not in PERTURBATIONS:
        raise BadArgument("perturbation", repr(perturbation), f"one of {', '.join(PERTURBATIONS)}")
    return PERTURBATIONS[perturbation]


@checked
def household_mass(volume: Positive, known: Positive | None = None) -> float:
    """Return the mass [kg] of an object: the known one, else by `DENSITY` and volume [m^3] within `MASSES`.

    >>> household_mass(1e-6), household_mass(1e-3), household_mass(1e-3, known=0.3)
    (0.05, 0.5, 0.3)
    """
    return known if known is not None else min(max(DENSITY * volume, MASSES[0]), MASSES[1])


@checked
def perturb_trial(spec: TrialSpec, perturbation: Perturbation, mass: Positive, seed: Seed) -> TrialSpec:
    """Return a trial with the true mass [kg] and with a friction that is drawn.

    >>> perturb_trial(TrialSpec(), PERTURBATIONS["mass"], 0.5, 0).mass
    0.5
    """
    changes = {"mass": mass, "density": None} if perturbation.mass else {}
    if perturbation.friction is not None:
        low, high = perturbation.friction
        share = float(torch.rand((), generator=_generator(seed, "friction"), dtype=torch.float64))
        changes["friction"] = low + (high - low) * share
    return dataclasses.replace(spec, **changes)


@checked
def perturb_view(cloud: PointCloud, perturbation: Perturbation, seed: Seed) -> tuple[PointCloud, Plane]:
    """Return what a planner is told of an object on the table z = 0: the cloud and the table.

    Mask and depth change the points, the camera's error moves all of them with the viewpoint. The table has errors of
    its own.

    Args:
        cloud: what the camera saw [m], with its viewpoint; it stays as it is.
        perturbation: what is wrong.
        seed: of every draw.

    Raises:
        BadArgument: a cloud without a viewpoint, if the mask, the depth or the camera is wrong.

    >>> from torchgrasp import load_object
    >>> view = load_object("jug").view
    >>> seen, table = perturb_view(view, Perturbation(table=0.005), seed=0)
    >>> torch.equal(seen.points, view.points), 0 < abs(table.offset) <= 0.005
    (True, True)
    """
    device, here = cloud.points.device, cloud.to("cpu")
    table, points = _perturb_table(here, perturbation, seed).to(device), here.points.double()
    if not (perturbation.mask or perturbation.depth or any(perturbation.camera)):
        return cloud, table
    if here.viewpoint is None:
        raise BadArgument("cloud", "no viewpoint", "one, where the camera is wrong or what it saw")
    viewpoint = here.viewpoint.double()
    if perturbation.mask:
        kept = ~find_rim(points, viewpoint, round(perturbation.mask * len(points)), seed)
        count = round(perturbation.mask / (1 - perturbation.mask) * int(kept.sum()))
        points = torch.cat([points[kept], table_beside(points, viewpoint, count, seed)])
    if perturbation.depth:
        noise = torch.randn(len(points), 1, generator=_generator(seed, "depth"), dtype=torch.float64)
        points = points + perturbation.depth * noise * unit(points - viewpoint)
    seen = PointCloud(points.to(here.points), None, here.viewpoint, here.frustum)
    return move(seen, _camera_error(viewpoint, perturbation.camera, seed)).to(device), table


def find_rim(points: Float[Tensor, "n 3"], viewpoint: Float[Tensor, "3"], count: int, seed: int) -> Bool[Tensor, " n"]:
    """Choose `count` points at the rim of what a camera sees: corners of the outline of their triangulated image.

    If the outline has more, they are drawn; if it has fewer, the points nearest to it follow.
    """
    from scipy.spatial import Delaunay, KDTree

    pixels = _image(points, points, viewpoint).numpy()
    triangles = torch.from_numpy(Delaunay(pixels).simplices).long()
    edges = torch.cat([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]).sort(1).values
    image = torch.from_numpy(pixels)
    length = torch.linalg.vector_norm(image[edges[:, 0]] - image[edges[:, 1]], dim=1).reshape(3, -1)
    inside = length.amax(0) <= LONG_EDGE * length.median()
    found, sides = torch.unique(edges.reshape(3, -1, 2)[:, inside].flatten(0, 1), dim=0, return_counts=True)
    outline = torch.unique(found[sides == 1])
    distance = torch.from_numpy(KDTree(pixels[outline.numpy()]).query(pixels)[0])
    order = torch.randperm(len(points), generator=_generator(seed, "rim"))
    chosen = order[distance[order].argsort(stable=True)[:count]]
    return torch.zeros(len(points), dtype=torch.bool).index_fill(0, chosen, True)


def table_beside(
    points: Float[Tensor, "n 3"], viewpoint: Float[Tensor, "3"], count: int, seed: int
) -> Float[Tensor, "k 3"]:
    """Draw points of the table z = 0 that a wrong mask adds to an object's.

    Each is at most `BESIDE` [m] beside a point of the object, as seen from above, and the object does not hide it.

    Raises:
        BadArgument: the camera sees no table there.
    """
    from scipy.spatial import KDTree

    generator, pixels = _generator(seed, "table points"), KDTree(_image(points, points, viewpoint).numpy())
    spacing = float(torch.from_numpy(pixels.query(pixels.data, k=2)[0][:, 1]).median())
    found = torch.empty(0, 3, dtype=torch.float64)
    for _ in range(ROUNDS):
        row = torch.randint(len(points), (8 * count,), generator=generator)
        turn, share = torch.rand(2, 8 * count, generator=generator, dtype=torch.float64)
        shift = torch.stack([(2 * math.pi * turn).cos(), (2 * math.pi * turn).sin()], 1)
        drawn = points[row, :2] + BESIDE * share.sqrt()[:, None] * shift
        drawn = torch.cat([drawn, torch.zeros(8 * count, 1, dtype=torch.float64)], 1)
        beyond = torch.from_numpy(pixels.query(_image(drawn, points, viewpoint).numpy())[0]) > MASK_GAP * spacing
        found = torch.cat([found, drawn[beyond]])[:count]
        if len(found) == count:
            return found
    raise BadArgument("cloud", f"{len(found)} points of the table beside it in view", f"{count}, as of a table z = 0")


def _image(
    points: Float[Tensor, "n 3"], seen: Float[Tensor, "m 3"], viewpoint: Float[Tensor, "3"]
) -> Float[Tensor, "n 2"]:
    """Return where points are in the image of a camera that looks at the middle of what it sees."""
    forward = unit((seen.amin(0) + seen.amax(0)) / 2 - viewpoint)
    across = torch.linalg.svd(forward[None]).Vh[1:]
    return ((points - viewpoint) @ across.T) / ((points - viewpoint) @ forward)[:, None]


def _perturb_table(cloud: PointCloud, perturbation: Perturbation, seed: int) -> Plane:
    """Return a table that is off in height and tilted about the point below the cloud."""
    if not (perturbation.table or perturbation.up):
        return Plane.horizontal(0.0)
    sign = -1.0 if float(torch.rand((), generator=_generator(seed, "table"))) < 0.5 else 1.0
    foot = cloud.points.double().mean(0) * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    foot[2] = sign * perturbation.table
    azimuth = 2 * math.pi * float(torch.rand((), generator=_generator(seed, "up"), dtype=torch.float64))
    lean = math.sin(perturbation.up)
    normal = [lean * math.cos(azimuth), lean * math.sin(azimuth), math.cos(perturbation.up)]
    up = torch.tensor(normal, dtype=torch.float64)
    return Plane(up, float(up @ foot))


def _camera_error(viewpoint: Float[Tensor, "3"], amounts: tuple[float, float], seed: int) -> Float[Tensor, "4 4"]:
    """Return the motion of all that a wrong camera sees: it turns about the camera and is shifted."""
    direction, axis = unit(torch.randn(2, 3, generator=_generator(seed, "camera"), dtype=torch.float64))
    rotation = rotation_from_vector(amounts[1] * axis)
    return rigid(rotation, viewpoint - rotation @ viewpoint + amounts[0] * direction)


def _generator(seed: int, factor: str) -> torch.Generator:
    """Return the generator of one factor."""
    return torch.Generator().manual_seed(seed_of(seed, factor))
