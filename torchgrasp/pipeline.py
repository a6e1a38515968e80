"""From a partial point cloud, or a thing of a scene, to ranked grasps, in one call."""

import dataclasses
from typing import Any, get_args

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import count_status
from torchgrasp.cloud.check import remove_duplicates
from torchgrasp.errors import BadArgument, Status
from torchgrasp.files import sha256
from torchgrasp.finger_sets import Observer, finger_sets, plan_sets
from torchgrasp.frames import inverse
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.hand_toml import Fingers
from torchgrasp.ik.candidates import GraspProblem, Reachable
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.cobyla import solve_as_paper
from torchgrasp.ik.contact_first import solve_contact_first
from torchgrasp.ik.joint import solve_joint
from torchgrasp.ik.motion import collision_probability, lift_clearance
from torchgrasp.ik.obstacles import Obstacles
from torchgrasp.ik.posture_library import PostureLibrary, keep_nearest, nearest_postures
from torchgrasp.ik.query import query_mixture
from torchgrasp.ik.ranking import rank_by_success, rank_by_variance, success_features, success_log_odds
from torchgrasp.ik.sdf import field_from_surface
from torchgrasp.linalg import farthest_points
from torchgrasp.plan.certify import certify
from torchgrasp.plan.solve import plan_contacts
from torchgrasp.plan.starts import settle_flatness
from torchgrasp.plane import cloud_to_upright, move, upright_frame
from torchgrasp.posture_model.mixture import PAPER_ENERGY, GraspMixture, load_mixture, mixture_path
from torchgrasp.provenance import metadata
from torchgrasp.scene.occupancy import estimate_occupancy
from torchgrasp.scene.scene import Scene
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.surface import Surface, extract_surface
from torchgrasp.specs import ContactSpec, Mode, Ranking
from torchgrasp.values import ContactPlan, Grasps, PointCloud

TRIPLES = 250
"""Planned triples offered to the hand."""
SCENE_TRIPLES = 160
"""Triples offered in a scene, where more postures of each are tried: first grasps come in 1.5 times as long."""
OFFERED = 4
"""Rows of four or five contacts offered for each that is tried: the nearest to postures of the hand. Few are in reach,
and of the nearest twice as many (docs/fingers.md)."""
BURIED_DEPTH = 0.003
"""Depth [m] in obstacles, beyond that of neighbours that touch, at which something lies on a lifted surface."""
TARGET_POINTS = 1000
"""Points taken of a scene's target: local quadrics of as many span a centimetre, ten times a camera's noise."""


def spread_rows(plan: ContactPlan, most: int) -> Int[Tensor, "k"]:
    """Return at most `most` successful rows, far apart, in plan order."""
    rows = torch.nonzero(plan.status == Status.OK)[:, 0]
    if len(rows) <= most:
        return rows
    points = plan.contacts.points[rows]
    order = torch.argsort(points[..., 2], dim=1, stable=True)  # contacts in another order are the same triple
    points = points.gather(1, order[..., None].expand(-1, -1, 3)).flatten(1)
    chosen = farthest_points(points, most, first=int(plan.quality[rows].argmin()))
    return rows[chosen.sort().values]


def describe(counts: dict[Status, int]) -> str:
    """Return counts of statuses as one line, the successes first.

    >>> describe({Status.NOT_CLOSED: 2, Status.OK: 1})
    '1 ok, 2 not_closed'
    """
    ordered = sorted(counts.items(), key=lambda pair: pair[0] is not Status.OK)
    return ", ".join(f"{n} {s.name.lower()}" for s, n in ordered) or "none"


def plan_grasps(
    cloud: PointCloud | Scene,
    hand: Hand,
    spec: ContactSpec | None = None,
    starts: int = 1000,
    seed: int = 0,
    *,
    fingers: Fingers | None = None,
    mode: Mode = "joint",
    ranking: Ranking | None = None,
    shape: ShapeGP | None = None,
    observer: Observer = lambda stage, message, value: None,
    reachable: Reachable | None = None,
) -> Grasps:
    """Plan grasps of a hand on the object of a partial point cloud, or on the target of a scene.

    The result does not depend on the frame of cloud, camera and table. In a scene the hand keeps clear of the target's
    neighbours and of space that may be full. The rest of that risk lowers `Grasps.success`.

    Args:
        cloud: what the camera saw [m]; missing normals and viewpoint are estimated. A `Scene` has a target.
        hand: from `load_hand`; it follows the shape, which is where the cloud is, to its device.
        spec: the constraints on contacts, of which each finger gets one; None: `ContactSpec()`, in mode "paper"
            `ContactSpec.paper()`.
        starts: random starts of the contact planner.
        seed: of every random draw; on the CPU the same seed gives bitwise the same grasps.
        fingers: which grasp, as in `load_hand`; None: those of the hand. "auto": of the sets that the hand declares,
            the one whose best grasps are likeliest to succeed. The result names them; `hand_of` loads their hand.
        mode: see `Mode`. All but "joint" need the hand's learned model, and three fingers.
        ranking: see `Ranking`; None: "success", in mode "paper" "variance".
        shape: the object's shape if more is known than the cloud shows, as after a touch (`ShapeGP.update`).
        observer: called after each stage, see `Observer`.
        reachable: tells which poses `obj_from_hand` (k, 4, 4) an arm can reach, in the given frame; None: all.

    Returns:
        Grasps, those with `Status.OK` first, best first. There may be none.

    Raises:
        BadArgument: an argument of the wrong type or range; a cloud that no object of graspable size gives; a scene
            without a target.

    >>> from torchgrasp import load_hand, load_object
    >>> view = load_object("cylinder").view
    >>> grasps = plan_grasps(view, load_hand("barrett"), starts=20)
    >>> grasps.joints.shape[1]
    4
    """
    if not isinstance(hand, Hand):
        raise BadArgument("hand", type(hand).__name__, "a Hand from load_hand")
    _check_names(mode, ranking)
    as_paper = mode == "paper"
    spec = (ContactSpec.paper() if as_paper else ContactSpec()) if spec is None else spec
    ranking = ranking or ("variance" if as_paper else "success")
    hands, scene = finger_sets(hand, fingers, mode), None
    if isinstance(cloud, Scene):
        scene, cloud = cloud, take_target(cloud, seed)
        spec = dataclasses.replace(spec, table=scene.table if spec.table is None else spec.table)
    cloud = remove_duplicates(cloud)
    mixture, mixture_sha256 = None, "none"
    if mode != "joint":
        path = mixture_path(hand.urdf_path.parent)
        mixture, mixture_sha256 = load_mixture(path), sha256(path)
    obj_from_upright = upright_frame(cloud, spec.plane)
    if shape is None:
        level = None if spec.table is None else 0.0
        support = "paper" if as_paper else "camera"
        shape = fit_shape(cloud_to_upright(cloud, obj_from_upright), support=support, seed=seed, table=level)
    else:
        shape = shape.moved(inverse(obj_from_upright))
    task = _Task(
        hand,
        shape,
        dataclasses.replace(spec, table=None if spec.table is None else 0.0),
        starts,
        seed,
        mode,
        ranking,
        mixture,
        None if scene is None else scene.to_upright(obj_from_upright),
        None if reachable is None else lambda poses: reachable(obj_from_upright.to(poses) @ poses),
        lambda stage, message, value: observer(stage, message, _moved(value, obj_from_upright)),
    )
    hand, grasps = plan_sets(hands, lambda one, observer: _plan(task.of(one, observer)), task.observer)
    grasps = _moved(grasps, obj_from_upright)
    meta = {
        "mode": mode,
        "ranking": ranking,
        "mixture_sha256": mixture_sha256,
        "starts": str(starts),
        "seed": str(seed),
    }
    grasps = dataclasses.replace(grasps, meta=metadata(cloud, hand, spec) | meta)
    observer("refine", f"{len(grasps)} refined: {describe(count_status(grasps.status))}", grasps)
    return grasps


def _check_names(mode: str, ranking: str | None) -> None:
    """Refuse an unknown mode or ranking."""
    if mode not in get_args(Mode):
        raise BadArgument("mode", repr(mode), f"one of {', '.join(map(repr, get_args(Mode)))}")
    if ranking is not None and ranking not in get_args(Ranking):
        raise BadArgument("ranking", repr(ranking), "'success', 'variance' or None")


def _moved(value: Any, obj_from_upright: Float[Tensor, "4 4"]) -> Any:
    """Return a result in the given frame."""
    return value.moved(obj_from_upright) if isinstance(value, ShapeGP) else move(value, obj_from_upright)


@dataclasses.dataclass(frozen=True)
class _Task:
    """What grasps are planned from, in the upright frame."""

    hand: Hand
    shape: ShapeGP
    spec: ContactSpec
    starts: int
    seed: int
    mode: Mode
    ranking: Ranking
    mixture: GraspMixture | None
    scene: Scene | None
    reachable: Reachable | None
    observer: Observer

    def of(self, hand: Hand, observer: Observer) -> "_Task":
        """Return the task of a hand with its fingertips."""
        spec = dataclasses.replace(self.spec.for_fingertips(float(hand.tips.radius.max())), fingertips=len(hand.tips))
        return dataclasses.replace(self, hand=hand.to(self.shape.device), spec=spec, observer=observer)


def _plan(task: _Task) -> Grasps:
    """Plan in the upright frame."""
    hand, shape, seed, observer = task.hand, task.shape, task.seed, task.observer
    spec = settle_flatness(shape, task.spec, seed)
    surface = extract_surface(shape)
    certain = float((surface.std_m < 0.004).double().mean())
    observer("shape", f"{len(shape.x)} points, {certain:.0%} of the surface certain to 4 mm", shape)
    plan = plan_contacts(shape, spec, task.starts, seed)
    observer("plan", f"{task.starts} starts: {describe(count_status(plan.status))}", plan)

    offered = plan.contacts[_offered_rows(task, plan)]
    certificate = certify(offered, spec)
    contacts, certificate = offered[certificate.closed], certificate[certificate.closed]
    observer("certify", f"{len(contacts)} of {len(offered)} closed at friction {spec.planned_friction:g}", certificate)

    obstacles = _find_obstacles(task)
    world = CollisionWorld(field_from_surface(surface.vertices, surface.faces), spec.plane, obstacles)
    problem = GraspProblem(hand, contacts, certificate, world, surface.vertices.mean(0), task.reachable)
    if task.mixture is None:
        library = PostureLibrary.of(hand, seed=seed)
        seeds = keep_nearest(nearest_postures(library, contacts, world, reachable=task.reachable), _tried(task))
    elif task.mode == "paper":
        seeds = query_mixture(hand, contacts, task.mixture.to(shape.device), n_seeds=1, max_energy=PAPER_ENERGY)
    else:
        seeds = query_mixture(hand, contacts, task.mixture.to(shape.device))
    observer("query", f"{len(seeds)} seeds for {len(torch.unique(seeds.row))} of {len(contacts)} triples", seeds)

    if task.mode == "joint":
        solved = solve_joint(problem, seeds, shape, spec)
    else:
        solved = (solve_as_paper if task.mode == "paper" else solve_contact_first)(problem, seeds)
    good = solved[solved.status == Status.OK]
    features = success_features(shape, good.contacts, problem.center, spec.friction, seed)
    log_odds = success_log_odds(features, hand.name)
    if obstacles is not None and obstacles.hard and _is_buried(surface, obstacles):
        buried = torch.where(solved.status == Status.OK, int(Status.BURIED), solved.status)
        return dataclasses.replace(solved, status=buried)
    if obstacles is not None:
        free = 1 - collision_probability(hand, good, obstacles).to(log_odds)
        log_odds = torch.logit(torch.sigmoid(log_odds) * free, eps=1e-6)
    ranked = rank_by_success(solved, log_odds)
    return ranked if task.ranking == "success" else rank_by_variance(ranked)


def _offered_rows(task: _Task, plan: ContactPlan) -> Int[Tensor, "k"]:
    """Return the successful rows that the hand tries: far apart, or in the paper all, the most certain first."""
    if task.mode != "paper" or task.ranking != "variance":
        return spread_rows(plan, _tried(task) * (1 if len(task.hand.tips) == 3 else OFFERED))
    rows, variance = torch.nonzero(plan.status == Status.OK)[:, 0], plan.contacts.variance
    assert variance is not None
    return rows[torch.argsort(variance[rows].sum(1), stable=True)]


def _tried(task: _Task) -> int:
    """Return how many rows of contacts the hand tries at most."""
    return TRIPLES if task.scene is None else SCENE_TRIPLES


def _find_obstacles(task: _Task) -> Obstacles | None:
    """Return what may stand in the way of the hand in a scene."""
    if task.scene is None or task.scene.target is None:
        return None
    occupancy = estimate_occupancy(task.scene, task.scene.target)
    return Obstacles.of(occupancy, hard=not task.spec.contact_allowed)


def _is_buried(surface: Surface, obstacles: Obstacles) -> bool:
    """Tell whether the lifted surface runs into obstacles, deeper than it touches them where it stands."""
    standing = float(obstacles.field.query(surface.vertices)[0].min())
    return lift_clearance(surface.vertices, obstacles) < min(standing, 0.0) - BURIED_DEPTH


def take_target(scene: Scene, seed: int) -> PointCloud:
    """Return the cloud of a scene's target, random `TARGET_POINTS` of its points at most.

    Raises:
        BadArgument: no target, or a label that no thing has.
        TooFewPoints: fewer than 4 points.
    """
    if scene.target not in scene.things:
        raise BadArgument("target", scene.target, f"one of the labels {list(scene.things)}: scene.select(label)")
    cloud, generator = scene.cloud(), torch.Generator().manual_seed(seed)
    rows = torch.randperm(len(cloud), generator=generator)[:TARGET_POINTS].sort().values
    return cloud.select(rows.to(cloud.points.device))
