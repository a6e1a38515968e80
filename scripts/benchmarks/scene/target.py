"""A given target among neighbours. The things stand close, touch and hide each other, and one of
them is to be lifted.

The target is given by its true mask, or by a click in its middle. The library finds the table and
the neighbours in one noisy depth image. The best grasp is tried among the true bodies, and further
ones where it fails. Bodies are of families that fitted no tree of the success model.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from train.household import CALIBRATING, FAMILIES, HouseholdBody, author_household, family_of

from benchmarks.common import Options, Row, bench, format_number, keep, mean_over, run_all
from benchmarks.scene.scenes import footprint, separation
from torchgrasp import ContactSpec, Grasps, GraspTask, Scene, load_hand, plan_scene
from torchgrasp.cloud.agreement import AGREEMENT, check_contacts
from torchgrasp.cloud.camera import INTRINSICS, look_at, render_depth
from torchgrasp.evaluation import PROTOCOLS
from torchgrasp.evaluation.intervals import count_by, format_share, share_over
from torchgrasp.evaluation.lift import lift_grasp
from torchgrasp.evaluation.several_tries import lift_grasps
from torchgrasp.evaluation.trial import TRIALS, GraspTrial, Truth
from torchgrasp.foundation.errors import BadArgument, GraspError, Status
from torchgrasp.geometry.frames import rigid, rotation_from_vector
from torchgrasp.geometry.plane import Plane
from torchgrasp.planner import ScenePlan
from torchgrasp.sim.scene_spec import Neighbour
from torchgrasp.values.specs import TrialSpec

SCENES = 100
NEIGHBOURS = (2, 6)
"""Scenes, and least and greatest number of neighbours."""
FIRST = 40_000
"""About the number of the first body: no body near it or beyond is in the success model's trials."""
LARGEST = 0.2
"""Greatest side [m] of a body: the hands grasp no larger ones."""
TOUCHING = 0.001
TOUCH = 0.5
APART = (0.01, 0.05)
"""Gap [m] of neighbours that touch, the share that does, and the gaps [m] of the others."""
COVERED = 0.1
"""Least share of the target that neighbours hide in every second scene."""
PIXELS = 300
"""Fewest pixels of the target in the image."""
ELEVATION = (30.0, 60.0)
DISTANCE = (0.5, 0.75)
"""Of the camera [deg, m]."""
OUTSIDE = 0.6
STEP = 0.002
"""Distance [m] from which a neighbour is moved towards the target, and the step."""
MOVED = 0.02
"""Motion [m] of a neighbour's centre that counts."""
KEPT = 0.95
"""Share of measured pixels that a good mask keeps."""
HIDDEN = (0.0, 1 / 3, 2 / 3, 1.0)
"""Edges of the shares of the target that neighbours hide, by which results are told."""
WAYS = ("mask", "click")
BARS = {"mask": 0.96, "click": 0.93}
TRIES = 3
"""Grasps that a robot tries which opens its hand after a failed lift."""
ELSEWHERE = "ELSEWHERE"
"""Status of grasps of other things, which the library took for the target."""
LIMIT = 1800.0
"""Limit [s] of the CPU time of one scene."""


@dataclasses.dataclass(frozen=True)
class Clutter:
    """Bodies on the table z = 0, the first of which is the target, and one depth image [m].

    `family` is the target's. `meshes` and their convex `parts` [m] are in the world's frame. In
    `labels`, 1 is the target. `hidden` is the share of the target's pixels that neighbours cover.
    """

    names: tuple[str, ...]
    family: str
    meshes: tuple[trimesh.Trimesh, ...]
    parts: tuple[list[trimesh.Trimesh], ...]
    depth: Float[Tensor, "h w"]
    labels: Int[Tensor, "h w"]
    camera_pose: Float[Tensor, "4 4"]
    hidden: float


@dataclasses.dataclass(frozen=True)
class TargetTry:
    """What became of one target that was given in one way, "mask" or "click".

    `purity` is the share of the pixels taken for the target that are its own. `share` is the share
    of its own measured pixels that are taken. Without a grasp, `said` is the reason, and `clear`
    counts the neighbours to take away first. `doubted` tells whether advice names the target. The
    prediction is NaN if the success is unknown. A refused target has pixels and prediction 0.
    `moved` [m] is the largest motion of a neighbour. These are of the first grasp alone.
    `held_in_three` tells whether it or, after failed lifts, one of two further grasps held.
    """

    scene: int
    family: str
    neighbours: int
    hidden: float
    way: str
    purity: float = 0.0
    share: float = 0.0
    executable: int = 0
    predicted: float = 0.0
    status: str = "NO_GRASP"
    moved: float = 0.0
    held_in_three: bool = False
    said: str = ""
    clear: int = 0
    doubted: bool = False

    @property
    def held(self) -> bool:
        """Whether the target was lifted and held."""
        return self.status == Status.OK.name

    @property
    def asked(self) -> bool:
        """Whether the library planned nothing and said why."""
        return self.status == "NO_GRASP" and bool(self.said)

    @property
    def unknown(self) -> bool:
        """Whether grasps were planned without a promise: advice says why their success is
        unknown.
        """
        return self.status != "NO_GRASP" and self.doubted and math.isnan(self.predicted)


@bench("scene/target")
def target(o: Options) -> list[Row]:
    """Lift one given thing of crowded scenes: by its mask, and by a click."""
    hand = o.hands[0]
    load_hand(hand)
    tasks = [(o, k, hand) for k in range(o.times(SCENES))]
    found = list[TargetTry]()
    for outcomes in run_all(try_scene, tasks, o.workers, LIMIT):
        tries = [read_try(outcome) for outcome in outcomes]
        print(*tries, sep="\n", flush=True)
        found += tries
    return [row for way in WAYS for row in describe(way, [x for x in found if x.way == way])]


def try_scene(o: Options, k: int, hand: str) -> list[dict[str, Any]]:
    """Try the target of scene k in each way (`WAYS`), and return the fields of each `TargetTry`.

    A result that an earlier call wrote to a file is read.
    """
    path = o.out / "target" / f"{hand}_{o.starts}_{o.simulator}_{k:03d}.json"

    def try_ways() -> list[dict[str, Any]]:
        clutter = make_clutter(np.random.default_rng([o.seed, k]), k)
        return [dataclasses.asdict(try_target(clutter, k, way, hand, o)) for way in WAYS]

    return keep(path, try_ways)


def read_try(outcome: dict[str, Any]) -> TargetTry:
    """Return a `TargetTry` from its fields in a JSON file, in which an unknown success is null."""
    if outcome["predicted"] is None:
        outcome = outcome | {"predicted": math.nan}
    return TargetTry(**outcome)


def make_clutter(draw: np.random.Generator, k: int) -> Clutter:
    """Return the k-th scene: random bodies pushed together around the target, and a camera's image.

    The camera sees enough of the target. In scenes of odd k, neighbours hide some of it.
    """
    while True:
        bodies = [draw_body(draw, k)]
        while len(bodies) <= draw.integers(NEIGHBOURS[0], NEIGHBOURS[1] + 1):
            bodies.append(draw_body(draw))
        poses = push_together([body.mesh for body in bodies], draw)
        meshes = tuple(moved(x.mesh, pose) for x, pose in zip(bodies, poses, strict=True))
        parts = tuple(
            [moved(part, pose) for part in x.parts] for x, pose in zip(bodies, poses, strict=True)
        )
        middle = torch.from_numpy(meshes[0].bounds.mean(0))
        pose = look_at(
            draw.uniform(0, 360), draw.uniform(*ELEVATION), draw.uniform(*DISTANCE), middle
        )
        depth, labels = render_depth(meshes, pose, seed=k)
        alone = int((render_depth(meshes[:1], pose, noise=False)[1] == 1).sum())
        seen = int((labels == 1).sum())
        hidden = 1 - seen / max(alone, 1)
        if seen >= PIXELS and hidden >= COVERED * (k % 2):
            names = tuple(body.name for body in bodies)
            return Clutter(names, bodies[0].family, meshes, parts, depth, labels, pose, hidden)


def draw_body(draw: np.random.Generator, k: int | None = None) -> HouseholdBody:
    """Return a random household body of the families that fitted no tree of the success model.

    With a number `k` it is of the k-th of these families, counted in a cycle.
    """
    among = sorted(CALIBRATING)
    family = among[k % len(among)] if k is not None else among[draw.integers(len(among))]
    place = list(FAMILIES).index(family)
    while True:
        number = FIRST - FIRST % len(FAMILIES) + len(FAMILIES) * int(draw.integers(200)) + place
        assert family_of(number) == family
        body = author_household(number)
        if max(body.mesh.extents) <= LARGEST:
            return body


def push_together(
    meshes: Sequence[trimesh.Trimesh], draw: np.random.Generator
) -> list[Float[Tensor, "4 4"]]:
    """Return poses (4, 4) [m] of upright meshes that stand close together, the first at the origin.

    Each other one is moved towards the origin from outside, until a gap to one of those before is
    reached. The gap is random, and sometimes that of a touch.
    """
    placed = list[Float[Tensor, "k 2"]]()
    poses = list[Float[Tensor, "4 4"]]()
    for mesh in meshes:
        turn = torch.tensor([0.0, 0.0, draw.uniform(0, 2 * math.pi)], dtype=torch.float64)
        rotation = rotation_from_vector(turn)
        outline = footprint(mesh) @ rotation[:2, :2].T
        gap = TOUCHING if draw.random() < TOUCH else draw.uniform(*APART)
        angle = draw.uniform(0, 2 * math.pi)
        towards = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
        distance = OUTSIDE if placed else 0.0
        while placed and distance > 0:
            nearer = outline + (distance - STEP) * towards
            if any(separation(nearer, other) < gap for other in placed):
                break
            distance -= STEP
        shift = distance * towards
        placed.append(outline + shift)
        poses.append(rigid(rotation, torch.cat([shift, shift.new_zeros(1)])))
    return poses


def moved(mesh: trimesh.Trimesh, pose: Float[Tensor, "4 4"]) -> trimesh.Trimesh:
    """Return a copy of a mesh [m], moved by the rigid transform `pose` (4, 4)."""
    return mesh.copy().apply_transform(pose.numpy())


def try_target(clutter: Clutter, k: int, way: str, hand: str, o: Options) -> TargetTry:
    """Find the target of scene k in its image, plan for it, and lift it by the best grasp.

    `way` says how the target is given: "mask" or "click".
    """
    trial = PROTOCOLS["table-lift"].with_trial(simulator=o.simulator).trial
    told = TargetTry(k, clutter.family, len(clutter.names) - 1, clutter.hidden, way)
    own = clutter.labels == 1
    given: dict[str, Any] = {"mask": own} if way == "mask" else {"point": middle_of(own)}
    model = load_hand(hand)
    spec = ContactSpec(friction=trial.friction)
    try:
        scene = Scene.from_depth(
            clutter.depth, INTRINSICS, clutter.camera_pose, up=(0.0, 0.0, 1.0), **given
        )
        task = GraspTask(mass=trial.mass, lift=True)
        plan = plan_scene(scene, model, spec, o.starts, o.seed, target=scene.target, task=task)
    except GraspError as error:
        return dataclasses.replace(told, said=str(error))
    names = ("the target", f"object {scene.target} ", f"and {scene.target} touch")
    doubted = any(name in line for line in scene.advice for name in names)
    taken = scene.pixel_labels == scene.target
    both = int((taken & own).sum())
    told = dataclasses.replace(
        told,
        purity=both / max(int(taken.sum()), 1),
        share=both / int((own & (clutter.depth > 0)).sum()),
        doubted=doubted,
    )
    return lift_target(clutter, plan, told, hand, trial, k)


def middle_of(mask: Tensor) -> tuple[int, int]:
    """Return the pixel (column, row) of a mask that is farthest from the mask's rim."""
    away = np.asarray(distance_transform_edt(mask.numpy()))
    row, column = np.unravel_index(int(away.argmax()), mask.shape)
    return int(column), int(row)


def lift_target(
    clutter: Clutter, plan: ScenePlan, told: TargetTry, hand: str, trial: TrialSpec, seed: int
) -> TargetTry:
    """Lift the target by the best grasp of a plan; return the try `told` with the outcome added.

    A target that it does not hold is lifted anew, with up to three grasps. Without a grasp, the
    reasons and the number of neighbours to take away are added.
    """
    best = plan.best
    if best is None or best.grasps is None:
        reasons = "; ".join(dict.fromkeys(x.reason for x in plan.things if x.reason))
        return dataclasses.replace(told, said=reasons, clear=len(plan.clear))
    own, *around = map(Neighbour, clutter.meshes, clutter.parts)
    table = Plane.horizontal(0.0)
    told = dataclasses.replace(told, executable=len(best.grasps), predicted=best.success)
    if are_elsewhere(best.grasps[:1], own.mesh):
        return dataclasses.replace(told, status=ELSEWHERE)
    truth = Truth(own.mesh, own.parts, table=table, neighbours=around)
    first = GraspTrial(load_hand(hand), best.grasps[0], truth, seed)
    closed = lift_grasp(first, trial)
    assert closed.disturbance is not None
    held_in_three = closed.held
    if not held_in_three and not are_elsewhere(best.grasps, own.mesh):
        several = dataclasses.replace(first, grasp=best.grasps)
        held_in_three = lift_grasps(several, trial, TRIES)[-1].result.held
    return dataclasses.replace(
        told,
        status=closed.status.name,
        moved=largest_motion(clutter.meshes[1:], closed.disturbance.neighbour_pose[-1]),
        held_in_three=held_in_three,
        said=best.reason,
    )


def are_elsewhere(grasps: Grasps, mesh: trimesh.Trimesh) -> bool:
    """Return whether most contacts of grasps are off the target's mesh [m], so no trial takes them.

    Then the library took other things for the target, and would grasp one of them.
    """
    try:
        check_contacts(grasps, mesh, TRIALS.slack, AGREEMENT.astray)
    except BadArgument:
        return True
    return False


def largest_motion(meshes: Iterable[trimesh.Trimesh], motion: Float[Tensor, "n 4 4"]) -> float:
    """Return the largest distance [m] by which a mesh's middle moves under rigid motions (n, 4, 4).

    There is one motion for each mesh.
    """
    middle = torch.stack([torch.from_numpy(mesh.bounds.mean(0)) for mesh in meshes])
    motion = motion.double()
    after = (motion[:, :3, :3] @ middle[..., None])[..., 0] + motion[:, :3, 3]
    return float(torch.linalg.vector_norm(after - middle, dim=-1).max())


def describe(way: str, tries: Sequence[TargetTry]) -> list[Row]:
    """Return the rows of all scenes whose target was given in one way."""
    planned = [x for x in tries if x.status != "NO_GRASP"]
    held = share_over(count_by((x.family, x.held) for x in tries))
    good = share_over(count_by((x.family, x.held or x.asked) for x in tries))
    wary = share_over(count_by((x.family, x.held or x.asked or x.doubted) for x in tries))
    frank = share_over(count_by((x.family, x.held or x.asked or x.unknown) for x in tries))
    unknown = [x for x in planned if x.unknown]
    promised = [x for x in planned if not math.isnan(x.predicted)]
    of_planned = share_over(count_by((x.family, x.held) for x in planned))
    pushed = share_over(count_by((x.family, x.moved > MOVED) for x in planned))
    error = mean_over((x.family, x.predicted - x.held) for x in planned)
    by_hidden = "; ".join(
        f"{low:.2f} to {high:.2f}: {describe_group([x for x in tries if low <= x.hidden < high])}"
        for low, high in itertools.pairwise(HIDDEN)
    )
    least = BARS[way]
    asking = way == "click"
    what = f"target by {way}"
    words = f"held {format_share(held)}; held or asked {format_share(good)}; "
    words += f"held, asked or told in the scene's advice {format_share(wary)}; "
    words += f"held of planned {format_share(of_planned)}"
    bar = f">= {least:.0%} held" + (" or asked" if asking else "")
    met = (good if asking else held).value >= least
    lifted = Row(what, bar, words, met, {"tries": [dataclasses.asdict(x) for x in tries]})

    third = share_over(count_by((x.family, x.held_in_three) for x in tries))
    words = f"held {format_share(third)}"
    again = Row(f"{what}, up to three grasps", "-", words)

    what += "; an unknown success, told with its cause, counts as asked"
    words = f"held, asked or told that success is unknown {format_share(frank)}; success unknown: "
    words += f"{len(unknown)}, of which {sum(x.held for x in unknown)} held; of those with a known "
    words += f"success {sum(x.held for x in promised)} of {len(promised)} held"
    told = Row(what, bar if asking else "-", words, frank.value >= least if asking else None)

    what = f"a neighbour moved by more than 2 cm, {way}"
    beside = Row(what, "<= 4 %", format_share(pushed, "scenes"), pushed.value <= 0.04)
    what = f"predicted minus held, {way}"
    predicted = Row(what, "<= 0.05", format_number(error), abs(error.value) <= 0.05)
    hidden = Row(f"by the share hidden, {way}", "-", by_hidden)

    whole = sum(x.share >= KEPT for x in tries)
    pure = sum(x.purity >= KEPT for x in tries)
    words = f"{whole} of {len(tries)} keep {KEPT:.0%} of the target's measured pixels; "
    words += f"{pure} hold {KEPT:.0%} of the target's own"
    pixels = Row(f"pixels taken for the target, {way}", "-", words)
    return [lifted, again, told, beside, predicted, hidden, pixels]


def describe_group(tries: Sequence[TargetTry]) -> str:
    """Return as text how many tries of a group held or had no grasp, and their mean prediction."""
    planned = [x for x in tries if x.status != "NO_GRASP"]
    if not tries:
        return "none"
    words = f"{sum(x.held for x in tries)} held, {len(tries) - len(planned)} without a grasp of {len(tries)}"
    known = [x.predicted for x in planned if not math.isnan(x.predicted)]
    if known:
        words += f", predicted {np.mean(known):.2f}"
    return words
