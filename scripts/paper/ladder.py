"""From the paper's chain to the library's, one stage exchanged at a time: what each is worth, on
the same views.
"""

from collections.abc import Iterator, Sequence
from typing import Any

from paper.rows import Cell, Plan, Row, TableSpec
from paper.tables6_7 import Asked, count_held, format_points, gather, median, write
from paper.trials import run_cells
from torchgrasp.evaluation.intervals import contrast_over, count_by, format_share, share_over
from torchgrasp.files import format_columns

PAPER_CHAIN = Plan("paper", "paper", margins=False)
SUPPORT = Plan("paper", margins=False)
RUNGS = (
    Row("paper", PAPER_CHAIN, "certain", "paper", "impedance"),
    Row("+ support", SUPPORT, "certain", "paper", "impedance"),
    Row("+ margins", Plan("paper"), "certain", "paper", "impedance"),
    Row("+ refinement", Plan("contact_first"), "certain", "paper", "impedance"),
    Row("+ postures", Plan(), "certain", "paper", "impedance"),
    Row("+ ranking", Plan(), "success", "paper", "impedance"),
    Row("+ closing", Plan(), "success", "uncertainty", "impedance"),
    Row("+ holding", Plan(), "success", "uncertainty", "force"),
)
"""Each rung exchanges one stage of the rung above it:

* support: where the shape is observed; + margins: the contact problem; + refinement: seeds on fixed
    contacts;
* + postures: seeds near each triple, contacts that slide; + ranking: by predicted success instead
  of variance;
* + closing and + holding: what the hand does.
"""


def ladder(spec: Asked) -> None:
    """Print what each stage is worth: the best grasp of each rung, lifted under the same errors of
    the object's pose.

    An object without an executable grasp fails, as often as it would have been lifted.

    Args:
        spec: what the table is made of.
    """
    judge_ladder(spec, run_cells(spec, RUNGS))


def judge_ladder(spec: TableSpec, cells: Iterator[tuple[Cell, ...]]) -> None:
    """Print and write the ladder of the cells of its rungs."""
    rows = gather(cells)
    numbers: dict[str, Any] = {}
    hands = dict.fromkeys(cell.hand for cell in rows[0])
    for hand in ("all", *hands) if len(hands) > 1 else hands:
        numbers[hand] = judge(
            spec, [[cell for cell in row if hand in ("all", cell.hand)] for row in rows]
        )
        print_ladder(hand, numbers[hand])
    write(spec.out / "ladder.json", spec, rows, {"ladder": numbers})


def judge(spec: TableSpec, rows: Sequence[Sequence[Cell]]) -> dict[str, dict[str, Any]]:
    """Return the numbers of each rung: shares over families, and paired differences to the rung
    above.
    """
    found: dict[str, dict[str, Any]] = {}
    above = None
    for row in rows:
        held = count_all(row, spec.grasps * spec.draws)
        found[row[0].row] = {
            "graspable": share_over(count_by((cell.family, bool(cell.lifts)) for cell in row)),
            "held_of_all": share_over(held),
            "held_of_lifted": share_over(count_held(row)),
            "worth": None if above is None else contrast_over([held, above], [1.0, -1.0]),
            "plan_cpu_s": median(cell.seconds for cell in row),
        }
        above = held
    return found


def count_all(row: Sequence[Cell], lifts: int) -> dict[str, tuple[int, int]]:
    """Return the lifts that held, and all, of each family; a view without a grasp fails in as many
    `lifts`.
    """
    outcomes = [(cell.family, lift.held) for cell in row for lift in cell.lifts]
    return count_by(
        outcomes + [(cell.family, False) for cell in row for _ in range(cell.refused * lifts)]
    )


def print_ladder(hand: str, found: dict[str, dict[str, Any]]) -> None:
    """Print the rungs of a hand."""
    keys = ("graspable", "held_of_all", "held_of_lifted")
    lines = [
        (
            f"{hand}: rung",
            "with a grasp",
            "held of all",
            "held of those with a grasp",
            "worth",
            "plan CPU",
        )
    ]
    for name, rung in found.items():
        worth = "-" if rung["worth"] is None else format_points(rung["worth"])
        lines.append(
            (name, *(format_share(rung[key]) for key in keys), worth, f"{rung['plan_cpu_s']:.1f} s")
        )
    print(f"\n{format_columns(lines, left={0, 1, 2, 3, 4})}")
