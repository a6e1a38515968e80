"""What each stage of the paper's chain leaves over: from starts of the planner to grasps that are
lifted.
"""

from collections import Counter

import torch

from torchgrasp import (
    ContactSpec,
    Status,
    TrialSpec,
    close_hand,
    list_objects,
    load_hand,
    load_object,
    plan_grasps,
)
from torchgrasp.files import format_columns
from torchgrasp.values.planning import Grasps, IKSeeds

TRIAL = TrialSpec(closing="paper", holding="impedance")

TITLE = (
    "object",
    "hand",
    "closed",
    "Eq. 21",
    "assigned",
    "COBYLA",
    "tips",
    "links",
    "rest",
    "good",
    "held",
)


def funnel(
    starts: int = 1000,
    seed: int = 0,
    hands: tuple[str, ...] = ("allegro", "barrett"),
    only: tuple[str, ...] = (),
    lifted: int = 3,
    edges: int = 8,
) -> None:
    """Print for each object and hand how many triples, assignments and grasps are left after each
    stage of the paper.

    The columns: triples with force closure; triples and assignments that Eq. (21) accepts;
    assignments on which COBYLA ran, and why those that failed did; executable grasps (good); which
    of the first few the paper's closing lifts.

    Args: starts: of the contact planner. seed: of every draw. hands: by name. only: names of
        objects; by default all of the project's. lifted: grasps of each object and hand that are
        closed and lifted; 0 needs no simulator. edges: of each friction cone in Eq. (13), whose
        number the paper does not give; fewer edges leave more margin.
    """
    torch.set_num_threads(1)
    spec = ContactSpec.paper(edges=edges, table=0.0)
    lines: list[tuple[str, ...]] = [TITLE]
    for name in only or list_objects():
        for hand in hands:
            lines.append(
                (name, hand, *map(str, count_stages(name, hand, spec, starts, seed, lifted)))
            )
            print("  ".join(lines[-1]), flush=True)
    print(f"\n{format_columns(lines, left={0, 1})}")


def count_stages(
    name: str, hand_name: str, spec: ContactSpec, starts: int, seed: int, lifted: int
) -> list[int | str]:
    """Return the numbers of one row: what every stage has left."""
    stages = dict[str, object]()
    hand = load_hand(hand_name)
    thing = load_object(name)
    note = lambda stage, text, value: stages.update({stage: value})  # noqa: E731
    grasps = plan_grasps(thing.view, hand, spec, starts, seed, mode="paper", observer=note)
    seeds = stages["query"]
    assert isinstance(seeds, IKSeeds)
    lost = Counter(Status(int(code)) for code in grasps.status)
    good = lost.pop(Status.OK, 0)
    tips = lost.pop(Status.TIP_ERROR, 0)
    links = sum(
        lost.pop(x, 0)
        for x in (Status.SELF_COLLISION, Status.OBJECT_COLLISION, Status.TABLE_COLLISION)
    )
    held = [lift(grasps[k], name, hand_name) for k in range(min(good, lifted))]
    closed = len(stages["certify"])  # pyright: ignore[reportArgumentType]
    accepted = [closed, len(seeds.row.unique()), len(seeds)]
    return [*accepted, len(grasps), tips, links, lost.total(), good, f"{sum(held)} of {len(held)}"]


def lift(grasp: Grasps, name: str, hand_name: str) -> bool:
    """Close the hand on the true object where it was seen, as in the paper, and lift it."""
    thing = load_object(name)
    return close_hand(grasp, load_hand(hand_name), thing.mesh, TRIAL, parts=thing.parts).held
