"""The table of gradients: each public function of tensors with the derivatives that it has.

A row of `ROWS` is a differentiable function. `MASKS` take tensors by which derivatives are taken,
and return none. All others refuse such tensors.
"""

import dataclasses
import functools
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchgrasp import (
    CarriedWeight,
    Contacts,
    ContactSpec,
    Distribution,
    GraspMixture,
    Hand,
    Plane,
    PointCloud,
    ShapeGP,
    certify,
    critical_friction,
    encode,
    hold_probability,
    load_hand,
)
from torchgrasp.control import law, squeeze
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.foundation.base import named_tensors
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.posture_model import GaussianMixture
from torchgrasp.posture_model.mixture import CODE_NAMES
from torchgrasp.shape import (
    HollowShape,
    Kernel,
    Normalisation,
    Observations,
    condition,
    matern52_kernel,
    rbf_kernel,
    thin_plate_kernel,
)
from torchgrasp.testing import random_joints

Function = Callable[..., Any]
Make = Callable[[torch.dtype], tuple[Function, tuple[Tensor, ...]]]
TWICE = 2
ONCE = 1


@dataclasses.dataclass(frozen=True)
class Row:
    """A differentiable function: in what, how often, and what makes a function of tensors with
    arguments for it.

    The first `batched` arguments may have more leading axes. `lacks` are checks that it does not
    pass.
    """

    by: str
    order: int
    make: Make
    batched: int = 0
    note: str = ""
    lacks: tuple[str, ...] = ()


def outputs(result: Any) -> tuple[Tensor, ...]:
    """Return the floating-point tensors of a result."""
    if isinstance(result, Tensor):
        return (result,) if result.is_floating_point() else ()
    if isinstance(result, dict):
        return tuple(result.values())
    parts = result if isinstance(result, tuple) else tuple(named_tensors(result).values())
    return tuple(x for part in parts for x in outputs(part))


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(
        shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64, device="cpu"
    )


def of_contacts(function: Function) -> Make:
    """Return what makes a function of points and normals of three sets of contacts."""

    def make(dtype: torch.dtype) -> tuple[Function, tuple[Tensor, ...]]:
        points = 0.05 * draw(3, 3, 3)
        normals = normalize(
            points - points.mean(1, keepdim=True) + 0.01 * draw(3, 3, 3, seed=1), dim=-1
        )
        return function, (points.to(dtype), normals.to(dtype))

    return make


def of_risk(function: Function, extra: Function) -> Make:
    """Return what makes a function of points, of normals of any length, and of an `extra` argument
    that is computed from points.
    """

    def make(dtype: torch.dtype) -> tuple[Function, tuple[Tensor, ...]]:
        points = 0.05 * draw(3, 3, 3)
        normals = normalize(
            points - points.mean(1, keepdim=True) + 0.02 * draw(3, 3, 3, seed=1), dim=-1
        )
        inputs = points, normals, extra(points)
        return (
            lambda p, n, *x: function(p, normalize(n, dim=-1), *x),
            tuple(x.to(dtype) for x in inputs if x is not None),
        )

    return make


STRONG = Distribution.between(0.0, 3.0)
"""A friction that any of these sets may have enough of."""


def hold(points: Tensor, normals: Tensor, tilt: Tensor) -> Tensor:
    contacts = Contacts(points, normals)
    return hold_probability(contacts, STRONG, 0.002, tilt, shift=0.002, turn=0.05)


def carry(points: Tensor, normals: Tensor, center: Tensor) -> Tensor:
    weight = CarriedWeight(0.3, center, press=5.0, center_std=0.01)
    return hold_probability(Contacts(points, normals), STRONG, 0.002, weight=weight)


def margin(points: Tensor, normals: Tensor) -> Tensor:
    return certify(Contacts(points, normals), ContactSpec()).margin


def code(points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
    found = encode((points, normals))
    return found.q, found.obj_from_vf


def of_mixture(
    kind: type[GaussianMixture],
    names: tuple[str, ...],
    query: Function,
    width: int,
    weighted: bool = True,
) -> Make:
    """Return what makes a function of rows and of a mixture's parameters; weights are a softmax."""
    d = len(names)
    root = 0.3 * draw(2, d, d) + torch.eye(d, device="cpu")
    means = draw(2, d, seed=1)
    logits = draw(2, seed=2)

    def function(x: Tensor, means: Tensor, root: Tensor, logits: Tensor = torch.zeros(2)) -> Any:  # noqa: B008
        # root @ root.mT, which autocast would round
        covariances = (root[..., None, :] * root[..., None, :, :]).sum(-1)
        covariances = (covariances + covariances.mT) / 2
        return query(kind(torch.softmax(logits, 0), means, covariances, names), x)

    def make(dtype: torch.dtype) -> tuple[Function, tuple[Tensor, ...]]:
        inputs = means[:, -width:] + 0.5, means, root, logits
        return function, tuple(x.to(dtype) for x in inputs[: 3 + weighted])

    return make


@functools.cache
def hand_of(dtype: torch.dtype) -> Hand:
    return load_hand("barrett").to(dtype)


def of_hand(method: str) -> Make:
    """Return what makes a method of a hand, a function of two postures."""

    def make(dtype: torch.dtype) -> tuple[Function, tuple[Tensor, ...]]:
        hand = hand_of(dtype).to("cpu")  # without what other calls have kept
        return getattr(hand, method), (random_joints(hand, 2, 0).to(dtype),)

    return make


def jacobian(dtype: torch.dtype) -> tuple[Function, tuple[Tensor, ...]]:
    """Return the Jacobian of points on the fingertips."""
    hand = hand_of(dtype).to("cpu")
    joints = random_joints(hand, 2, 0).to(dtype)
    return hand.jacobian, (joints, hand.fingertips(joints)[0] + 0.001)


def of_part(part: str, method: str, argument: Function) -> Make:
    """Return what makes a method of a part of a hand, a function of what `argument` computes from
    joints.
    """

    def make(dtype: torch.dtype) -> tuple[Function, tuple[Tensor, ...]]:
        hand = hand_of(dtype).to("cpu")
        return getattr(getattr(hand, part), method), (
            argument(hand, random_joints(hand, 2, 0).to(dtype)),
        )

    return make


def values_of(hand: Hand, joints: Tensor) -> Tensor:
    return hand.actuated.expand(joints).mT


def of_field(method: Function) -> Make:
    """Return what makes a method that takes points near the origin."""
    return lambda dtype: (method(dtype), (0.05 * draw(4, 3).to(dtype),))


def ball() -> SignedDistanceField:
    axis = torch.linspace(-0.2, 0.2, 21, dtype=torch.float64, device="cpu")
    return SignedDistanceField(
        axis[[0, 0, 0]], 0.02, torch.cartesian_prod(axis, axis, axis).norm(dim=1).view(21, 21, 21)
    )


def pressed(dtype: torch.dtype) -> tuple[Function, tuple[Tensor, ...]]:
    """Return squeeze as a function of the joints of a grasp."""
    hand = hand_of(dtype)
    grasps = load_shipped_grasp("jug", "barrett")
    press = lambda joints: squeeze(hand, dataclasses.replace(grasps, joints=joints))[::2]  # noqa: E731
    return press, (grasps.joints.to(dtype),)


KERNELS: dict[str, Kernel] = {
    "thin plate": thin_plate_kernel(4.0),
    "thin plate by autograd": thin_plate_kernel(4.0, closed_form=False),
    "matern52": matern52_kernel(1.5, 10.0),
    "rbf": rbf_kernel(1.5, 10.0),
    "own": Kernel(lambda r: 4.0 / (1.0 + 0.3 * r * r)),
}


SIDES = normalize(draw(6, 3), dim=-1)
TOLD = 0.1 * draw(6, seed=1)
CENTER = 0.01 * draw(3, seed=2)
NOISE = torch.linspace(0.02, 0.05, 6, dtype=torch.float64, device="cpu")
"""Six points of a unit ball, the distances told there, the centre of the frame, and the noise."""


def shape_of(
    kernel: str = "thin plate", distance: Tensor = TOLD, center: Tensor = CENTER
) -> ShapeGP:
    """Return a shape given six points, of which three have normals."""
    seen = Observations(SIDES, distance, SIDES, NOISE > 0.03, NOISE, 2 * NOISE)
    return condition(
        seen, Normalisation(center, 0.05), PointCloud(0.05 * SIDES), kernel=KERNELS[kernel]
    )


def vessel_of(center: Tensor = CENTER) -> HollowShape:
    return HollowShape.join(
        shape_of(center=center), shape_of("rbf", center=center), PointCloud(0.05 * SIDES)
    )


def of_shape(
    make_shape: Callable[[], ShapeGP],
    method: str,
    arguments: tuple[Any, ...] = (),
    kernel: str = "",
) -> Make:
    """Return what makes a method of a shape, a function of points in metres or of normalised ones."""

    def make(dtype: torch.dtype) -> tuple[Function, tuple[Tensor, ...]]:
        shape = make_shape()
        x = 0.8 * normalize(draw(2, 3, seed=3), dim=-1)
        points = shape.metres(x) if method in METRES[:-1] else x
        points = shape.distance_rows(x) if method in ("whiten", "ordered") else points
        points = points.mT if method == "ordered" else points
        call = getattr(shape, method)
        return (lambda p: call(p, *arguments)), (points.to(dtype),)

    return make


UNCOMPILED = "not inside torch.compile"
FITS = UNCOMPILED, ("single", "compile")
METRES = "predict", "differentiate", "joint", "sample", "normalise", "metres"
NORMALISED = "cross distance_rows estimate jet joint_at mean mean_and_gradient mean_jet variance whiten ordered".split()
"""Methods of a shape that take points in any frame and dtype, and those that take normalised points
of its own.
"""
SHAPES = {"torchgrasp.shape.gp.ShapeGP": shape_of, "torchgrasp.shape.hollow.HollowShape": vessel_of}
BATCHED = "predict", "differentiate", "normalise", "metres"


def of_center(make_shape: Callable[..., ShapeGP]) -> Make:
    """Return what makes estimates a function of the centre of a shape's frame."""
    x = torch.full((2, 3), 0.03, dtype=torch.float64, device="cpu")
    return lambda dtype: ((lambda center: make_shape(center=center).predict(x).distance), (CENTER,))


def of_distances(dtype: torch.dtype) -> tuple[Function, tuple[Tensor, ...]]:
    x = shape_of().metres(0.8 * normalize(draw(2, 3, seed=3), dim=-1))
    return (lambda distance: shape_of(distance=distance).predict(x).distance), (TOLD,)


UNCERTAIN = Distribution(((0.2, 0.5), (0.6, 0.6), (0.7, 1.2)), (0.5, 0.2, 0.3))
"""A distribution with two intervals and a single number."""


def of_probabilities(dtype: torch.dtype) -> tuple[Function, tuple[Tensor, ...]]:
    q = torch.tensor([[0.1, 0.3, 0.45], [0.75, 0.8, 0.9]], dtype=torch.float64, device="cpu")
    return UNCERTAIN.quantile, (q.to(dtype),)


def of_numbers(dtype: torch.dtype) -> tuple[Function, tuple[Tensor, ...]]:
    x = torch.tensor([[0.25, 0.3, 0.45], [0.75, 0.9, 1.1]], dtype=torch.float64, device="cpu")
    return UNCERTAIN.cdf, (x.to(dtype),)


CODE = ("j", *CODE_NAMES)
PLAIN = ("a", "b")
GAUSSIAN = "torchgrasp.posture_model.gaussian.GaussianMixture"
GRASP = "torchgrasp.posture_model.mixture.GraspMixture"


def densities(owner: str, kind: type[GaussianMixture], names: tuple[str, ...]) -> dict[str, Row]:
    """Return the rows of the methods that both kinds of mixtures have."""
    rest = names[1:]
    given = {names[0]: 0.3}
    queries: dict[str, tuple[Function, int, int]] = {
        "log_prob": (lambda mixture, x: mixture.log_prob(x), len(names), 1),
        "log_joint": (lambda mixture, x: mixture.log_joint(x), len(names), 0),
        "marginal": (lambda mixture, x: mixture.marginal(rest).log_prob(x), len(rest), 0),
        "condition": (lambda mixture, x: mixture.condition(given).log_prob(x), len(rest), 0),
    }
    by = {"marginal": "parameters", "condition": "parameters"}
    return {
        f"{owner}.{name}": Row(
            by.get(name, "points, parameters"),
            TWICE,
            of_mixture(kind, names, query, width),
            batched,
        )
        for name, (query, width, batched) in queries.items()
    }


ROWS: dict[str, Row] = {
    "torchgrasp.contacts.certify.certify": Row(
        "contacts, for the margin",
        ONCE,
        of_contacts(margin),
        note="by the dual; a subgradient where it is not unique",
    ),
    "torchgrasp.contacts.critical.critical_friction": Row(
        "points, unit normals",
        TWICE,
        of_risk(critical_friction, lambda _: None),
        2,
        note="that of one motion where several prove the friction",
    ),
    "torchgrasp.contacts.hold_probability.hold_probability": Row(
        "contacts, tilt, centre of mass",
        TWICE,
        of_risk(hold, lambda _: 0.05 + 0.01 * draw(3, 3, seed=5).abs()),
        note="also over drawn surfaces",
    ),
    "torchgrasp.values.distribution.Distribution.cdf": Row(
        "numbers", TWICE, of_numbers, note="the density; zero between intervals"
    ),
    "torchgrasp.values.distribution.Distribution.quantile": Row(
        "probabilities", TWICE, of_probabilities, note="zero at a single number"
    ),
    "torchgrasp.posture_model.mixture.encode": Row("points, normals", TWICE, of_contacts(code)),
    **densities(GAUSSIAN, GaussianMixture, PLAIN),
    **densities(GRASP, GraspMixture, CODE),
    f"{GRASP}.energy": Row(
        "codes, means, covariances",
        TWICE,
        of_mixture(GraspMixture, CODE, lambda m, q: m.energy(q), 6, weighted=False),
        note="a minimum over components",
    ),
    f"{GRASP}.joints": Row(
        "codes, parameters", TWICE, of_mixture(GraspMixture, CODE, lambda m, q: m.joints(q), 6)
    ),
    f"{GRASP}.modes": Row(
        "codes, parameters",
        TWICE,
        of_mixture(GraspMixture, CODE, lambda m, q: m.modes(q, 2), 6),
        note="the k largest",
    ),
    "torchgrasp.control.finger_forces.squeeze": Row("joints", TWICE, pressed),
    **{
        f"torchgrasp.hand.hand.Hand.{name}": Row("joints", TWICE, of_hand(name), 1)
        for name in "check_joints expand expand_joints fingertips link_poses sphere_centres tip_centres".split()
    },
    "torchgrasp.hand.hand.Hand.jacobian": Row("joints, points `at`", TWICE, jacobian, 2),
    "torchgrasp.hand.hand.Hand.self_clearance": Row(
        "joints", TWICE, of_hand("self_clearance"), 1, note="the least of all pairs"
    ),
    **{
        f"torchgrasp.hand.fingers.ActuatedJoints.{name}": Row(
            "joints", TWICE, of_part("actuated", name, lambda _, q: q), 1
        )
        for name in ("couple", "expand")
    },
    "torchgrasp.hand.fingers.Fingertips.frames": Row(
        "values", TWICE, of_part("tips", "frames", values_of)
    ),
    "torchgrasp.hand.kinematics.KinematicTree.frames": Row(
        "values", TWICE, of_part("tree", "frames", values_of)
    ),
    "torchgrasp.hand.kinematics.KinematicTree.poses": Row(
        "values", TWICE, of_part("tree", "poses", lambda h, q: h.actuated.expand(q))
    ),
    "torchgrasp.hand.kinematics.KinematicTree.joint_axes": Row(
        "poses", TWICE, of_part("tree", "joint_axes", lambda h, q: h.link_poses(q)), 1
    ),
    "torchgrasp.hand.self_collision.SelfCollision.clearance": Row(
        "frames",
        TWICE,
        of_part("self_collision", "clearance", lambda h, q: h.tree.frames(values_of(h, q))),
        note="the least of all pairs",
    ),
    "torchgrasp.geometry.plane.Plane.height": Row(
        "points", TWICE, of_field(lambda _: Plane.horizontal(0.1).height), 1
    ),
    "torchgrasp.geometry.signed_distance.SignedDistanceField.query": Row(
        "points",
        TWICE,
        of_field(lambda dtype: ball().to(dtype).query),
        1,
        note="inside a cell of the grid",
    ),
    **{
        f"{owner}.{name}": Row(
            "points",
            TWICE,
            of_shape(kind, name, (4,) if name == "sample" else ()),
            name in BATCHED,
            *((UNCOMPILED, ("compile",)) if name == "differentiate" else ()),
        )
        for owner, kind in SHAPES.items()
        for name in METRES
    },
    **{
        f"{owner}.{name}": Row(
            "rows" if name in ("whiten", "ordered") else "points",
            TWICE,
            of_shape(kind, name),
            note="in double precision" + f"; {UNCOMPILED}" * ("jet" in name),
            lacks=("single", "compile") if "jet" in name else ("single",),
        )
        for owner, kind in SHAPES.items()
        for name in NORMALISED
    },
    "torchgrasp.shape.fit.condition": Row(
        "observations, frame, kernel", TWICE, of_distances, 0, UNCOMPILED, ("single", "compile")
    ),
    "torchgrasp.shape.gp.ShapeGP.of": Row(
        "posterior, frame", TWICE, of_center(shape_of), 0, UNCOMPILED, ("single", "compile")
    ),
    "torchgrasp.shape.hollow.HollowShape.join": Row(
        "both shapes", TWICE, of_center(vessel_of), 0, UNCOMPILED, ("single", "compile")
    ),
    "torchgrasp.shape.kernel.Kernel.derivatives": Row(
        "r, kernel",
        TWICE,
        lambda dtype: (
            (lambda r: KERNELS["rbf"].derivatives(r, 3)),
            (draw(4).abs().to(dtype) + 0.1,),
        ),
    ),
    **{
        f"torchgrasp.shape.estimate.Normalisation.{name}": Row(
            "points",
            TWICE,
            of_field(
                lambda dtype, name=name: getattr(Normalisation(draw(3).to(dtype), 0.05), name)
            ),
            1,
        )
        for name in ("normalise", "metres")
    },
}
MASKS = {
    *(f"{owner}.{name}" for owner in SHAPES for name in ("contains", "wall_at")),
    "torchgrasp.shape.hollow.HollowShape.of",  # a vessel is made by `join`
    "torchgrasp.hand.fingers.ActuatedJoints.check",
    "torchgrasp.hand.fingers.ActuatedJoints.check_limits",
    "torchgrasp.hand.self_collision.SelfCollision.count_near",
}
"""Functions that count, choose or check: they take differentiated tensors, and their results have
no derivatives.
"""


def of_law(function: Function, *shapes: tuple[int, ...]) -> Row:
    """Return the row of a pure function of the closing law, twice differentiable in all its
    arguments.
    """
    inputs = [0.1 * draw(2, *shape, seed=k) for k, shape in enumerate(shapes)]
    return Row(
        "all arguments",
        TWICE,
        lambda dtype: (function, tuple(x.to(dtype) for x in inputs)),
        len(shapes),
    )


def spread(root: Tensor) -> Tensor:
    """Return covariances of a few centimetres."""
    return 0.1 * root @ root.mT + 0.003 * torch.eye(3, dtype=root.dtype, device=root.device)


LAW = {
    "surface_covariance": of_law(law.surface_covariance, (3,), ()),
    "printed_covariance": of_law(law.printed_covariance, (3,), ()),
    "force_covariance": of_law(law.force_covariance, (3,), (3,)),
    "blend": of_law(lambda error, root: law.blend(error, spread(root)), (3,), (3, 3)),
    "position_gain": of_law(lambda root: law.position_gain(spread(root)), (3, 3)),
    "force_gain": of_law(lambda root, alpha: law.force_gain(spread(root), alpha), (3, 3), ()),
    "damped_inverse": of_law(law.damped_inverse, (2, 4)),
    "tip_velocity": of_law(law.tip_velocity, (3,), (3,), (), (3,), (3,)),
    "stay_above": of_law(
        lambda v, h: law.stay_above(v, h, v.new_tensor([0.0, 0.6, 0.8])), (3,), ()
    ),
    "joint_step": of_law(
        lambda jacobian, velocity, error: law.joint_step(jacobian, velocity, 0.01, error),
        (3, 3, 4),
        (3, 3),
        (4,),
    ),
}
"""Functions of `torchgrasp.control.law`, from which a closing law is made; they are not public."""
LAW["hold_probability, weight"] = Row(
    "contacts, centre of mass", TWICE, of_risk(carry, lambda points: points.mean(1))
)
LAW |= {
    f"predict, {name}": Row("points", TWICE, of_shape(partial(shape_of, name), "predict"), 1)
    for name in KERNELS
}


def page() -> str:
    """Return the table as it stands in docs/gradients.md; one line has all functions of an owner
    that are alike.
    """
    alike: dict[tuple[str, ...], list[str]] = {}
    for name, row in ROWS.items():
        owner, function = name.split(".")[-2:]
        owner = owner if owner[0].isupper() else ""
        order = {ONCE: "once", TWICE: "twice"}[row.order]
        alike.setdefault((owner, row.by, order, row.note), []).append(f"`{function}`")
    lines = [
        "| of | functions | differentiable in | how often | note |",
        "| --- | --- | --- | --- | --- |",
    ]
    for (owner, by, order, note), functions in sorted(alike.items()):
        lines.append(
            f"| {owner and f'`{owner}`'} | {', '.join(functions)} | {by} | {order} | {note} |"
        )
    return "\n".join(lines) + "\n"
