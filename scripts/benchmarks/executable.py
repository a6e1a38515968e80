"""How many starts become grasps that a hand can take, and what one costs: contacts first, and solved together.

A start is certified when its planned contacts are (default specification with a table, LP margin and rank). A grasp is
executable when `check` finds every fingertip within 1 mm of its contact and inside its pad's cone, joints within their
limits, and links and pre-grasp clear of the estimated surface, the table and each other. The cost of a grasp is the
processor's time of planning, certificates, guesses and solving; the shape and its distance field are given.
"""

import time
from typing import Any

from tqdm import tqdm

from benchmarks.common import Row
from torchgrasp import ContactSpec, Status, certify, fit_shape, load_hand, load_mixture, plan_contacts
from torchgrasp.base import count_status
from torchgrasp.hand.clear import Surroundings
from torchgrasp.hand.collide import field_from_surface
from torchgrasp.hand.nearest import PostureSet, nearest_postures
from torchgrasp.hand.query import query_hand
from torchgrasp.hand.realise import realise
from torchgrasp.hand.together import realise_together
from torchgrasp.shape.surface import extract_surface

SPEC = ContactSpec(table=0.0)
BARS = {("allegro", "contact_first"): 0.60, ("allegro", "together"): 0.85}
"""Least mean share of certified starts that become executable."""
COST = 20.0
"""Most milliseconds of an executable grasp of the Allegro hand, mean over objects, solved together."""


def bench_executable(views: list[Any], starts: int, seed: int) -> list[Row]:
    """Count executable grasps of both hands and modes on the first view of each object."""
    first = {name: cloud for name, _, cloud, _ in reversed(views)}
    hands = {name: load_hand(name) for name in ("allegro", "barrett")}
    found: dict[tuple[str, str], dict[str, dict[str, Any]]] = {}
    for name, cloud in tqdm(first.items(), desc="executable", disable=None, leave=False):
        shape = fit_shape(cloud, seed=seed, table=SPEC.table)
        surface = extract_surface(shape)
        surroundings = Surroundings(field_from_surface(surface.vertices, surface.faces), SPEC.table)
        began = time.process_time()
        plan = plan_contacts(shape, SPEC, starts, seed)
        certificate = certify(plan.contacts, SPEC)
        closed = (plan.status == Status.OK) & certificate.closed
        contacts, certificate = plan.contacts[closed], certificate[closed]
        planned = time.process_time() - began
        for hand_name, hand in hands.items():
            given = hand, contacts, certificate, surroundings, surface.vertices.mean(0)
            for mode in ("contact_first", "together"):
                began = time.process_time()
                if mode == "together":
                    guess = nearest_postures(contacts, PostureSet.of(hand, seed=seed), surroundings)
                    grasps = realise_together(guess, *given, shape, SPEC)
                else:
                    grasps = realise(query_hand(contacts, hand, load_mixture(hand_name)), *given)
                good = int((grasps.status == Status.OK).sum())
                found.setdefault((hand_name, mode), {})[name] = {
                    "certified": len(contacts),
                    "executable": good,
                    "share": good / max(len(contacts), 1),
                    "ms": 1e3 * (planned + time.process_time() - began) / max(good, 1),
                    "statuses": {status.name: count for status, count in count_status(grasps.status).items()},
                }
    return [_row(*key, objects, starts) for key, objects in found.items()]


def _row(hand: str, mode: str, objects: dict[str, dict[str, Any]], starts: int) -> Row:
    """Return the row of one hand and mode: means over the objects, and each object's own numbers."""
    share, cost, certified, good = (
        sum(o[key] for o in objects.values()) / len(objects) for key in ("share", "ms", "certified", "executable")
    )
    bar = BARS.get((hand, mode))
    wanted = [] if bar is None else [f"share >= {bar}"] + [f"<= {COST:g} ms"] * (mode == "together")
    each = ", ".join(f"{n} {o['share']:.2f} ({o['executable']}, {o['ms']:.0f} ms)" for n, o in objects.items())
    counts = f"of {starts} starts {certified:.0f} certified, {good:.0f} executable"
    return Row(
        f"certified starts that become executable grasps, {hand}, {mode}, mean of {len(objects)} objects",
        " and ".join(wanted) or "none",
        f"{share:.3f}, {cost:.1f} ms a grasp; {counts}; {each}",
        None if bar is None else share >= bar and (mode != "together" or cost <= COST),
        {"objects": objects},
    )
