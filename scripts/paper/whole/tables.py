"""The tables of the page, from the numbers that each part wrote: the paper's beside ours."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from paper.fig6 import PUBLISHED as GAUSSIANS
from paper.table3 import PUBLISHED as FILTERED
from paper.table4_fig5 import PUBLISHED as PLANNED
from paper.table4_fig5 import THRESHOLDS
from paper.table5_fig7_fig8 import PUBLISHED as PREDICTED
from paper.table5_fig7_fig8 import PUBLISHED_ALLEGRO
from paper.tables6_7 import PUBLISHED as HELD
from torchgrasp.evaluation import Share

HAND, OBJECTS = "allegro", ("cylinder", "spray", "jug")
"""The hand and the objects of the paper's Tables 6 and 7, in its order."""


class Table(NamedTuple):
    """Heads, rows, and the columns that hold numbers."""

    heads: tuple[str, ...]
    rows: list[tuple[str, ...]]
    numbers: range


def table3(content: dict[str, Any]) -> Table:
    """Return Table 3."""
    heads = ("object", "cloud, shape", "points", "filter s", "shape s", "the paper's", "points", "filter s", "shape s")
    rows = []
    for row in content["rows"]:
        as_paper = row["cloud"] == "whole"
        theirs = tuple(str(x) for x in FILTERED[row["object"]]) if as_paper else ("",) * 4
        ours = (str(row["points"]), f"{row['filter_s']:.2f}", f"{row['shape_s']:.3f}")
        rows.append((row["object"], f"{row['cloud']}, {row['setting']}", *ours, *theirs))
    return Table(heads, rows, range(2, 9))


def table4(content: dict[str, Any]) -> Table:
    """Return Table 4."""
    heads = ("object", "problem", "S", f"of {content['starts']}", "ms a start", "Q cm", "closes")
    heads += ("the paper's", "of 1000", "s a start", "Q cm")
    rows = []
    for row in content["rows"]:
        as_paper = row["threshold"] == THRESHOLDS[0] and row["setting"] == "paper"
        theirs = PLANNED[row["object"]] if as_paper else ("",) * 4
        quality = f"{row['quality']:.3f} ± {row['spread']:.3f}" if row["grasps"] > 1 else "-"
        ours = (f"{row['threshold']:.2f}", str(row["grasps"]), f"{row['milliseconds']:.2f}", quality)
        beside = tuple(str(x).replace("+-", "±") for x in theirs)
        rows.append((row["object"], row["setting"], *ours, _number(row["probability"]), *beside))
    return Table(heads, rows, range(2, 11))


def fig6(content: dict[str, Any]) -> Table:
    """Return the numbers of Gaussians that Fig. 6 chooses."""
    heads = ("hand", "least criterion", "greatest held-out likelihood", "least held-out error", "the paper")
    rows = []
    for hand, row in content.items():
        means = {key: [sum(x) / len(x) for x in row[key]] for key in ("log_likelihood", "error")}
        best = (_least(row["bic"]), _least([-x for x in means["log_likelihood"]]), _least(means["error"]))
        rows.append((hand, *(str(row["components"][k]) for k in best), str(GAUSSIANS[hand])))
    return Table(heads, rows, range(1, 5))


def table5(content: dict[str, Any]) -> Table:
    """Return Table 5."""
    cases = tuple(f"case {k + 1}" for k in range(4))
    rows = []
    for k, ours in enumerate(content["cases"]):
        mean, deviation = PREDICTED["overall"][k]
        theirs = (f"J{k + 1}", *(f"{x:g}" for x in PREDICTED["cases"][k]), f"{mean} ± {deviation}")
        spread = f"{content['mean'][k]:.3f} ± {content['spread'][k]:.3f}"
        rows.append((f"joint {k + 1}", *(f"{x:.3f}" for x in ours), spread, *theirs))
    return Table(("joint", *cases, "overall", "the paper's", *cases, "overall"), rows, range(1, 12))


def fig8(content: dict[str, Any]) -> Table:
    """Return the means of Fig. 8."""
    mean = sum(content["mean"]) / len(content["mean"])
    rows = [(f"{mean:.3f}", f"{content['floor']:.3f}", f"about {PUBLISHED_ALLEGRO}")]
    return Table(("mean over joints", "median posture of the nearest codes", "the paper's"), rows, range(3))


def held(content: dict[str, Any]) -> Table:
    """Return Table 6 or 7: the paper's objects, then all objects and hands."""
    names = tuple(f"{name} %" for name in OBJECTS)
    heads = ("row", *names, "all objects and hands %", "with a grasp", f"the paper's {', '.join(OBJECTS)} %")
    counts, rows = count_own(content), []
    for name, numbers in content["rows"].items():
        own = tuple(_percent(*counts[name][x]) for x in OBJECTS)
        theirs, share = ", ".join(HELD.get(name, "").split()), _share(numbers["held"])
        rows.append((name, *own, _format(share), f"{numbers['graspable']} of {numbers['objects']}", theirs))
    return Table(heads, rows, range(1, 7))


def count_own(content: dict[str, Any]) -> dict[str, dict[str, tuple[int, int]]]:
    """Return how many lifts held, and of how many, of the paper's objects with its hand in each row."""
    found = {name: dict.fromkeys(OBJECTS, (0, 0)) for name in content["rows"]}
    for cell in content["cells"]:
        name = cell["object"].removeprefix("own ")
        if cell["hand"] == HAND and cell["object"].startswith("own ") and name in OBJECTS:
            good = sum(lift["status"] == "OK" for lift in cell["lifts"])
            found[cell["row"]][name] = (good, len(cell["lifts"]))
    return found


def ladder(content: dict[str, Any]) -> Table:
    """Return the ladder: each hand, and what each rung is worth to both."""
    hands = [hand for hand in content["ladder"] if hand != "all"]
    heads = (
        "rung",
        *(head for hand in hands for head in (f"{hand}: with a grasp %", "held of all %")),
        "worth, points",
    )
    rows = []
    for rung, together in content["ladder"]["all"].items():
        each = [content["ladder"][hand][rung] for hand in hands]
        shares = [_format(_share(found[key])) for found in each for key in ("graspable", "held_of_all")]
        rows.append((rung, *shares, _points(together["worth"])))
    return Table(heads, rows, range(1, len(heads)))


TABLES: dict[str, Callable[[dict[str, Any]], Table]] = {
    "table3": table3,
    "table4": table4,
    "fig6": fig6,
    "table5": table5,
    "fig8": fig8,
    "table6": held,
    "table7": held,
    "ladder": ladder,
}
"""Of the parts that write numbers."""


def _share(found: Sequence[float | None]) -> Share:
    """Return a share that was written as JSON, in which NaN is null."""
    value, low, high, total, units = (math.nan if x is None else x for x in found)
    return Share(value, low, high, int(total), int(units))


def _format(share: Share) -> str:
    """Return a share in per cent with its interval and its number of trials."""
    if math.isnan(share.value):
        return "-"
    ends = "" if math.isnan(share.low) else f" [{100 * share.low:.0f}, {100 * share.high:.0f}]"
    return f"{100 * share.value:.0f}{ends} of {share.total}"


def _points(found: Sequence[float | None] | None) -> str:
    """Return a paired difference in points."""
    if found is None:
        return ""
    share = _share(found)
    ends = "" if math.isnan(share.low) else f" [{100 * share.low:+.0f}, {100 * share.high:+.0f}]"
    return f"{100 * share.value:+.0f}{ends}"


def _percent(good: int, of: int) -> str:
    """Return a share of few lifts with their number."""
    return f"{good / of:.0%} of {of}".replace("%", "") if of else "no grasp"


def _number(value: float | None) -> str:
    """Return a number, or a dash where nothing was measured."""
    return "-" if value is None or math.isnan(value) else f"{value:.2f}"


def _least(values: Sequence[float]) -> int:
    """Return the place of the least value."""
    return min(range(len(values)), key=values.__getitem__)
