"""Places where a norm, a ratio or a choice of a differentiable function meets its kink."""

import itertools
import math
from collections.abc import Callable, Iterator

import torch
from torch import Tensor
from torch.nn.functional import normalize

from tests.gradients.table import LAW, SHAPES, SIDES, hand_of
from tests.make import real

F64 = torch.float64
Inputs = tuple[Tensor, ...]
Places = Callable[[Inputs], Iterator[Inputs]]
SIZE = 0.03


def ring(count: int, turn: float = 0.0) -> Tensor:
    """Return the corners of a regular polygon about the origin."""
    angle = turn + torch.arange(count, dtype=F64, device="cpu") * 2 * math.pi / count
    return SIZE * torch.stack([angle.cos(), angle.sin(), 0 * angle], -1)


def figures(count: int) -> Iterator[Inputs]:
    """Yield the points and normals of sets of contacts that are regular or degenerate."""
    up = real([0.0, 0.0, 1.0]).expand(count, 3)
    side = real([1.0, -1.0] * 3)[:count, None]
    along = torch.linspace(-SIZE, SIZE, count, dtype=F64, device="cpu")[:, None]
    for turn in (0.0, 0.3):
        corners = ring(count, turn)
        outward = corners / SIZE
        yield from ((corners, normals) for normals in (outward, -outward, up, side * up))
    doubled = torch.cat([corners[:1], corners[:-1]])
    yield doubled, normalize(doubled, dim=-1)
    yield 0 * corners, outward
    yield along * up, outward
    yield along * up, side * real([1.0, 0.0, 0.0])
    facing = side * real([1.0, 0.0, 0.0])
    for spread in (0.0, 0.3):
        yield SIZE * facing + spread * along * up, facing
        yield SIZE * facing + spread * along * up, side * up


def solids() -> Iterator[Inputs]:
    """Yield a regular tetrahedron, a square with normals along two sides, and two pyramids."""
    corners = real([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    yield SIZE * corners, normalize(corners, dim=-1)
    flat = corners * real([1.0, 1.0, 0.0])
    yield SIZE * flat, corners * real([1.0, 0.0, 0.0])
    double = torch.cat([ring(3), real([[0.0, 0, SIZE], [0, 0, -SIZE]])])
    yield double, double / SIZE


def all_figures(_: Inputs) -> Iterator[Inputs]:
    """Yield all figures with the same number of contacts as the rows of one batch."""
    found = [*itertools.chain(*map(figures, (3, 4, 5)), solids())]
    for count in (3, 4, 5):
        alike = [figure for figure in found if len(figure[0]) == count]
        yield tuple(map(torch.stack, zip(*alike, strict=True)))


def tilted(_: Inputs) -> Iterator[Inputs]:
    """Yield the same with errors of the normals, and without."""
    for points, normals in all_figures(()):
        for tilt in (0.05, 0.0):
            yield points, normals, torch.full_like(points[..., 0], tilt)


def carried(_: Inputs) -> Iterator[Inputs]:
    """Yield the same with a centre of mass among the contacts."""
    return ((points, normals, points.mean(1)) for points, normals in all_figures(()))


def triples(_: Inputs) -> Iterator[Inputs]:
    return ((points[None], normals[None]) for points, normals in figures(3))


def postures(x: Inputs) -> Iterator[Inputs]:
    """Yield joints at zero, at both limits and in the middle."""
    hand = hand_of(F64)
    for q in (0 * hand.lower, hand.lower, hand.upper, (hand.lower + hand.upper) / 2):
        joints = q.expand_as(x[0]).clone()
        yield (joints, *(hand.fingertips(joints)[0] for _ in x[1:]))


def values(x: Inputs) -> Iterator[Inputs]:
    hand = hand_of(F64)
    yield from ((hand.actuated.expand(q).mT,) for (q,) in postures((torch.zeros(2, hand.dof),)))


def rows(x: Inputs) -> Iterator[Inputs]:
    yield from ((v.mT,) for (v,) in values(x))


def poses(x: Inputs) -> Iterator[Inputs]:
    """Yield links that all lie in one place."""
    one = torch.eye(4, dtype=F64, device="cpu")
    yield (one.expand_as(x[0]).clone(),)


def frames(x: Inputs) -> Iterator[Inputs]:
    one = torch.eye(4, dtype=F64, device="cpu")[:3]
    yield (one[:, :, None, None].expand_as(x[0]).clone(),)


def at_nodes(x: Inputs) -> Iterator[Inputs]:
    """Yield points at nodes, on edges and sides of cells, on the border, and beyond it."""
    for number in (0.0, 0.02, 0.01, 0.2, 0.3, -0.2, -0.5):
        yield (torch.full_like(x[0], number),)
        yield (x[0].new_tensor([number, 0.0, 0.01]).expand_as(x[0]).clone(),)


def at_components(x: Inputs) -> Iterator[Inputs]:
    """Yield the place of a component, with others in the same place, and a weight of zero."""
    query, means, root, *logits = x
    at = means[:, -query.shape[-1] :].clone()
    yield (at, means, root, *logits)
    yield (at, means[:1].expand_as(means).clone(), root, *logits)
    if logits:
        yield (at, means, root, real([0.0, -1e4]))
        yield (at + 100, means, root, real([0.0, -1e4]))


def distances(x: Inputs) -> Iterator[Inputs]:
    yield (torch.zeros_like(x[0]),)


def at_points(name: str) -> Places:
    """Return what yields points of a shape: those that are seen, its centre, and twice the same."""

    def places(x: Inputs) -> Iterator[Inputs]:
        shape = SHAPES[name.rpartition(".")[0]]()
        method = name.rpartition(".")[2]
        twice = SIDES[:1].expand(2, 3)
        for unit in (SIDES[:2], 0 * SIDES[:2], twice, 1.5 * SIDES[:2], 3 * SIDES[3:5]):
            yield (shape.metres(unit) if method in METRES else unit.clone(),)

    return places


METRES = "predict", "differentiate", "joint", "sample", "normalise"


def same(x: Inputs) -> Iterator[Inputs]:
    """Yield arguments that are all 0, and all 1."""
    yield tuple(torch.zeros_like(v) for v in x)
    yield tuple(torch.ones_like(v) for v in x)


PLACES: dict[str, Places] = {
    "certify": all_figures,
    "critical_friction": all_figures,
    "hold_probability": tilted,
    "hold_probability, weight": carried,
    "encode": triples,
    "squeeze": lambda x: iter([x]),
    "Kernel.derivatives": distances,
    "SignedDistanceField.query": at_nodes,
    "KinematicTree.poses": rows,
    "KinematicTree.frames": values,
    "Fingertips.frames": values,
    "KinematicTree.joint_axes": poses,
    "SelfCollision.clearance": frames,
}


def places_of(name: str) -> Places:
    """Return what yields the kinks of a row of the table."""
    if name in PLACES:
        return PLACES[name]
    if name in LAW:
        return at_points("torchgrasp.shape.gp.ShapeGP.predict") if "predict" in name else same
    owner, method = name.split(".")[-2:]
    if owner in ("Hand", "ActuatedJoints"):
        return postures
    if owner in ("GaussianMixture", "GraspMixture"):
        return at_components
    if owner in ("ShapeGP", "HollowShape") and method not in ("of", "join", "whiten", "ordered"):
        return at_points(name)
    short = method if method in PLACES else f"{owner}.{method}"
    return PLACES.get(short, same)
