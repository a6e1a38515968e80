"""What the headline bench writes: README's table, its page of results, and the plans that they
stand for.

A test compares the plans with those of the present code. So the table is measured again when the
library plans otherwise.
"""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks.common import ROOT, Options, Row, command_line, describe_run, format_rows
from torchgrasp import ContactSpec, Status, load_hand, load_object, plan_grasps
from torchgrasp.evaluation.intervals import Share, format_share
from torchgrasp.files import write_file

PAGE = ROOT / "docs" / "results" / "headline.md"
README = ROOT / "README.md"
PLANS = ROOT / "docs" / "results" / "headline.json"
BEGIN = "<!-- written by scripts/bench.py headline --publish -->"
END = "<!-- end of what scripts/bench.py wrote -->"
"""Lines of README between which its table stands."""

ABOUT = """# Headline

Measured by one command at one commit, on objects of 20 families that chose no constant, fit or rule.
Intervals are 95 % over families. Lifts have protocol `table-lift`: 0.249 kg, friction 0.8 at the fingertips and 0.2 at
the table, a lift by 0.2 m from one noisy view. "Risen" means by more than 0.1 m at the end.

`{command}`

{run}
"""

GOLDEN = (("jug", "allegro"), ("cylinder", "barrett"), ("rabbit", "allegro"), ("spray", "barrett"))
STARTS = 8
"""Objects and hands of the plans that are compared, and their random starts."""


def write_headline(rows: Sequence[Row], options: Options) -> None:
    """Write all rows of the headline bench: as README's table and as the page of results.

    Also write the plans that identify how the library planned at this commit.
    """
    run = describe_run(options.threads)
    about = ABOUT.format(command=command_line(), run=run)
    write_file(PAGE, "\n".join([about, *format_rows(rows)]) + "\n")
    write_file(README, replace_table(README.read_text("utf-8"), list(readme_table(rows, run))))
    content = {"run": run, "plans": golden_plans()}
    write_file(PLANS, json.dumps(content, indent=1) + "\n")


def readme_table(rows: Sequence[Row], run: str) -> list[str]:
    """Return the Markdown lines of README's table: lifts by hand, condition and simulator.

    `run` is the text of `describe_run`, which names the commit.
    """
    commit = run.split(";")[0].removeprefix("Commit ")
    lines = [
        f"Measured at commit {commit} by `scripts/bench.py headline`.",
        "",
        "| hand, object | risen with up to three grasps | with the first alone | no grasp |",
        "| --- | --- | --- | --- |",
    ]
    for row in rows:
        n = row.numbers
        if "condition" not in n:
            continue
        where = "" if n["simulator"] == "sapien" else ", in MuJoCo"
        risen, first = (format_percent(Share(*n[key])) for key in ("risen", "first"))
        what = f"{n['hand'].capitalize().replace('Leap', 'LEAP')}: {n['condition']}{where}"
        lines.append(f"| {what} | {risen} | {first} | {n['refused']} of {n['objects']} |")
    return lines


def format_percent(share: Share) -> str:
    """Return a share and its interval as text, without the number of trials."""
    return format_share(share).split(" of ")[0]


def replace_table(text: str, lines: Sequence[str]) -> str:
    """Return README's text with `lines` between its marks `BEGIN` and `END`, in place of what is
    there.
    """
    block = "\n".join([BEGIN, "", *lines, "", END])
    pattern = re.compile(re.escape(BEGIN) + ".*?" + re.escape(END), re.DOTALL)
    if not pattern.search(text):
        raise SystemExit(f"README.md has no lines {BEGIN} and {END}")
    return pattern.sub(lambda _: block, text)


def golden_plans() -> dict[str, Any]:
    """Return what identifies a plan of each golden pair of object and hand.

    These are the number of candidates of each status. Of the best grasp they are its joints [rad],
    its contacts [m] and its log-odds.
    """
    return {f"{name}/{hand}": _plan(name, hand) for name, hand in GOLDEN}


def _plan(name: str, hand: str) -> dict[str, Any]:
    spec = ContactSpec(friction=0.8, table=0.0)
    grasps = plan_grasps(load_object(name).view, load_hand(hand), spec, STARTS, seed=0)
    kinds, counts = torch.unique(grasps.status, return_counts=True)
    statuses = {Status(int(k)).name: int(n) for k, n in zip(kinds, counts, strict=True)}
    return {
        "statuses": statuses,
        "joints": grasps.joints[0].tolist(),
        "contacts": grasps.contacts.points[0].tolist(),
        "log_odds": float(grasps.score[0]),
    }


def read_plans(path: Path = PLANS) -> dict[str, Any]:
    """Return the plans of `golden_plans` that were written to a file with the published table."""
    return json.loads(path.read_text("utf-8"))["plans"]
