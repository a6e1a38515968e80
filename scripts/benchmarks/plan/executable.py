"""How many starts become grasps that a hand can take, and what one costs, in both modes.

A start is certified when its planned contacts are (default specification with a table, LP margin and rank). A grasp is
executable when every fingertip is within 1 mm of its contact and inside its pad's cone, joints within their
limits, and links and pre-grasp clear of the estimated surface, the table and each other. The cost of a grasp is the
processor's time of planning, certificates, seeds and solving; the shape and its distance field are given.
"""

import time
from typing import Any

import torch
from tqdm import tqdm

from benchmarks.common import Options, Row, bench
from benchmarks.ground_truth import read_views
from torchgrasp import ContactSpec, Grasps, Hand, Status, certify, fit_shape, load_hand, load_mixture, plan_contacts
from torchgrasp.geometry.frames import apply
from torchgrasp.geometry.signed_distance import field_from_surface
from torchgrasp.ik.attempts import solve_contact_first
from torchgrasp.ik.candidates import TIP_PENETRATION, GraspProblem
from torchgrasp.ik.clearance import CLEARANCE, SELF_CLEARANCE, CollisionWorld
from torchgrasp.ik.joint import solve_joint
from torchgrasp.ik.seeds import PostureLibrary, nearest_postures, query_mixture
from torchgrasp.shape.surface import extract_surface

SPEC = ContactSpec(table=0.0)
BARS = {("allegro", "contact_first"): 0.60, ("allegro", "joint"): 0.85}
"""Least mean share of certified starts that become executable."""
BLOCKERS = ("palm", "finger links", "self", "table", "tips", "reach", "pad", "opening", "contacts")
"""What keeps a certified triple from a grasp. A solver that cannot have all leaves each a little: what its best failure
lacks most of, of the clearances that it was asked for, blocks it. Where no clearance is lacking, the fingertips do not
reach ("reach", "pad"), the hand cannot open, or contacts that slid have lost their certificate."""
COST = 20.0
"""Most milliseconds of an executable grasp of the Allegro hand, mean over objects, solved together."""


def bench_executable(views: list[Any], starts: int, seed: int) -> list[Row]:
    """Count executable grasps of both hands and modes on the first view of each object."""
    first = {name: cloud for name, _, cloud, _ in reversed(views)}
    hands = {name: load_hand(name) for name in ("allegro", "barrett")}
    results: dict[tuple[str, str], dict[str, dict[str, Any]]] = {}
    for name, cloud in tqdm(first.items(), desc="executable", disable=None, leave=False):
        shape = fit_shape(cloud, seed=seed, table=SPEC.table)
        surface = extract_surface(shape)
        world = CollisionWorld(field_from_surface(surface.vertices, surface.faces), SPEC.plane)
        began = time.process_time()
        plan = plan_contacts(shape, SPEC, starts, seed)
        certificate = certify(plan.contacts, SPEC)
        closed = (plan.status == Status.OK) & certificate.closed
        contacts, certificate = plan.contacts[closed], certificate[closed]
        planned = time.process_time() - began
        for hand_name, hand in hands.items():
            problem = GraspProblem(hand, contacts, certificate, world, surface.vertices.mean(0))
            for mode in ("contact_first", "joint"):
                began = time.process_time()
                if mode == "joint":
                    seeds = nearest_postures(PostureLibrary.of(hand, seed=seed), contacts, world)
                    grasps = solve_joint(problem, seeds, shape, SPEC)
                else:
                    seeds = query_mixture(hand, contacts, load_mixture(hand_name))
                    grasps = solve_contact_first(problem, seeds)
                good = int((grasps.status == Status.OK).sum())
                results.setdefault((hand_name, mode), {})[name] = {
                    "certified": len(contacts),
                    "executable": good,
                    "share": good / max(len(contacts), 1),
                    "ms": 1e3 * (planned + time.process_time() - began) / max(good, 1),
                    "blocked": count_blockers(hand, grasps, world),
                }
    return [_row(*key, objects, starts) for key, objects in results.items()]


def count_blockers(hand: Hand, grasps: Grasps, world: CollisionWorld) -> dict[str, float]:
    """Return the share of triples that each of `BLOCKERS` kept from a grasp, by the best failure of each triple."""
    spheres, centres = hand.collision_spheres, apply(grasps.obj_from_hand, hand.sphere_centres(grasps.joints))
    assert world.field is not None and world.plane is not None
    clearance = world.field.query(centres)[0] - spheres.radius
    height = (world.plane.height(centres) - spheres.radius).amin(1)
    parts = (spheres.finger == -1, (spheres.finger != -1) & ~spheres.touching, spheres.touching)
    palm, links, tips = (torch.where(part, clearance, torch.inf).amin(1) for part in parts)
    lack = torch.stack(
        [
            CLEARANCE - palm,
            CLEARANCE - links,
            SELF_CLEARANCE - hand.self_clearance(grasps.joints),
            -height,
            -TIP_PENETRATION - tips,
        ],
        1,
    )
    status = grasps.status
    blocker = torch.where(lack.amax(1) > 0, lack.argmax(1), torch.where(status == Status.NORMAL_ANGLE, 6, 5))
    blocker = torch.where(status == Status.PREGRASP, 7, torch.where(status < Status.OUT_OF_REACH, 8, blocker))
    counts = torch.bincount(blocker[status != Status.OK], minlength=len(BLOCKERS))
    return dict(zip(BLOCKERS, (counts / max(len(grasps), 1)).tolist(), strict=True))


def format_blockers(hand: str, mode: str, objects: dict[str, dict[str, Any]]) -> str:
    """Return a table of what became of each object's certified triples, and what blocked the others, in percent."""
    head = f"{f'{hand}, {mode}':26}{'certified':>10}{'grasps':>8}" + "".join(f"{name:>13}" for name in BLOCKERS)
    mean = {key: sum(o["blocked"][key] for o in objects.values()) / len(objects) for key in BLOCKERS}
    share = sum(o["share"] for o in objects.values()) / len(objects)
    certified = sum(o["certified"] for o in objects.values()) / len(objects)
    rows = [(name, o["certified"], o["share"], o["blocked"]) for name, o in objects.items()]
    lines = [
        f"  {name:24}{count:10.0f}{part:8.0%}" + "".join(f"{blocked[key]:13.1%}" for key in BLOCKERS)
        for name, count, part, blocked in [*rows, ("mean", certified, share, mean)]
    ]
    return "\n".join([head, *lines])


def _row(hand: str, mode: str, objects: dict[str, dict[str, Any]], starts: int) -> Row:
    """Return the row of one hand and mode: means over the objects, and each object's own numbers."""
    share, cost, certified, good = (
        sum(o[key] for o in objects.values()) / len(objects) for key in ("share", "ms", "certified", "executable")
    )
    bar = BARS.get((hand, mode))
    wanted = [] if bar is None else [f"share >= {bar}"] + [f"<= {COST:g} ms"] * (mode == "joint")
    each = ", ".join(f"{n} {o['share']:.2f} ({o['executable']}, {o['ms']:.0f} ms)" for n, o in objects.items())
    counts = f"of {starts} starts {certified:.0f} certified, {good:.0f} executable"
    return Row(
        f"certified starts that become executable grasps, {hand}, {mode}, mean of {len(objects)} objects",
        " and ".join(wanted) or "none",
        f"{share:.3f}, {cost:.1f} ms a grasp; {counts}; {each}",
        None if bar is None else share >= bar and (mode != "joint" or cost <= COST),
        {"hand": hand, "mode": mode, "objects": objects},
    )


@bench("plan/executable", objects=True)
def executable(o: Options) -> list[Row]:
    """Print what became of certified triples by object, hand and mode, and return the rows of the means."""
    rows = bench_executable(list(read_views(o.objects[0], views=o.views)), o.starts, o.seed)
    for row in rows:
        print(format_blockers(row.numbers["hand"], row.numbers["mode"], row.numbers["objects"]), flush=True)
    return rows
