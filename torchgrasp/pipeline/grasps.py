"""From a partial point cloud, or a thing of a scene, to ranked grasps, in one call."""

import torch

from torchgrasp.base import count_status
from torchgrasp.errors import Status
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.hand_toml import Fingers
from torchgrasp.ik.candidates import Reachable
from torchgrasp.pipeline.fingers import Observer, plan_sets
from torchgrasp.pipeline.stages import Bench
from torchgrasp.pipeline.task import Request, Task, Work
from torchgrasp.plan.solve import plan_contacts
from torchgrasp.scene.scene import Scene
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.specs import ContactSpec, Mode, Ranking
from torchgrasp.values import Grasps, PointCloud

CERTAIN = 0.004
"""Standard deviation [m] of the surface below which the line of the stage "shape" calls it certain."""


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
        Grasps, those with `Status.OK` first, best first. There may be none: `explain_empty` tells why.

    Raises:
        BadArgument: an argument of the wrong type or range; a cloud that no object of graspable size gives; a scene
            without a target.

    >>> from torchgrasp import load_hand, load_object
    >>> view = load_object("cylinder").view
    >>> grasps = plan_grasps(view, load_hand("barrett"), starts=20)
    >>> grasps.joints.shape[1]
    4
    """
    request = Request(cloud, hand, spec, starts, seed, fingers, mode, ranking, shape, observer, reachable)
    work = Work.of(request)
    hand, grasps = plan_sets(work.hands, lambda one, note: plan_one(work.task.of(one, note)), work.task.observer)
    grasps = work.give_back(grasps, hand)
    observer("refine", f"{len(grasps)} refined: {describe(count_status(grasps.status))}", grasps)
    return grasps


def plan_one(task: Task) -> Grasps:
    """Plan with one set of fingers in the upright frame."""
    bench, shape, observer = Bench(task), task.shape, task.observer
    certain = float((bench.surface.std_m < CERTAIN).double().mean())
    observer("shape", f"{len(shape.x)} points, {certain:.0%} of the surface certain to {1e3 * CERTAIN:g} mm", shape)
    plan = plan_contacts(shape, bench.spec, task.starts, task.seed)
    observer("plan", f"{task.starts} starts: {describe(count_status(plan.status))}", plan)
    offered, certificate = bench.offer(plan)
    contacts, certificate = offered[certificate.closed], certificate[certificate.closed]
    friction = bench.spec.planned_friction
    observer("certify", f"{len(contacts)} of {len(offered)} closed at friction {friction:g}", certificate)
    seeds = bench.seeds(contacts)
    observer("query", f"{len(seeds)} seeds for {len(torch.unique(seeds.row))} of {len(contacts)} triples", seeds)
    return bench.rank(bench.solve(contacts, certificate, seeds))
