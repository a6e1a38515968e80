"""Figures of README and guides: each is measured again by `scripts/reproduce.py claims`, or is a
limit or a default.
"""

import dataclasses
import inspect
import re
from pathlib import Path

import pytest
from benchmarks.common import ROOT, Options
from claims import measured, run, table

from torchgrasp import ContactSpec, TrialSpec, load_hand
from torchgrasp.app.cli import COMMANDS
from torchgrasp.app.cli.inputs import MOST_POINTS
from torchgrasp.cloud.check import FEW_POINTS
from torchgrasp.cloud.parts import GAP
from torchgrasp.cloud.prepare import FACING
from torchgrasp.control.holding import PUSH
from torchgrasp.control.uncertainty_closing import STALLED
from torchgrasp.evaluation import PROTOCOLS
from torchgrasp.evaluation.sweep import PLAN_LIMIT, TRIAL_LIMIT
from torchgrasp.foundation import limits
from torchgrasp.hand.collision_shapes import collision_pairs
from torchgrasp.planner.run import BEST
from torchgrasp.shape.fit import MAX_BUDGET
from torchgrasp.values.specs import FLAT_RADII, SEPARATION, TIP_RADIUS

GUIDES = ["README.md", *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md"))]
NUMBER = r"(?<![\w.\-])(?:\d[\d,]*(?:\.\d+)?|\.\d+|two|three|four|five|six|seven|eight|nine|ten|twenty|thirty)"
UNIT = r"(?:%|m?s\b|seconds?|minutes?|hours?|[mc]?m\b|N\b|[KMG]i?B\b|deg|rad\b|Hz\b|times\b|points\b|million|of \d+)"
FIGURE = re.compile(f"{NUMBER}[ -]?{UNIT}")

FOUR = load_hand("allegro", "four")
SPEC = ContactSpec()
TRIAL = TrialSpec()
MIB = 1024**2
LIFT = PROTOCOLS["table-lift"].trial
EXTENT = f"{1e3 * limits.MIN_EXTENT:.0f} mm to {limits.MAX_EXTENT:.0f} m"
*WIDER, NARROWEST = (f"{1e3 * radius:.0f}" for radius in FLAT_RADII)
LOWEST = [f"{1e3 * ContactSpec(friction=friction).least_height:.0f}" for friction in (0.8, 0.3)]
POSTURES = inspect.signature(collision_pairs).parameters["n"].default
CONSTANTS = {
    "README.md": (f"along a straight {TRIAL.approach:g} m", f"lifted by {LIFT.lift_height:g} m"),
    "docs/closing.md": (
        f"until its drives press with {STALLED:g} N",
        f"a push of {PUSH:g} N from any side",
    ),
    "docs/clouds.md": (
        f"all but {MOST_POINTS // 1000} 000 points",
        f"an extent outside {EXTENT}",
        f"more than {100 * FACING:.0f} %",
        f"more than {1e3 * GAP:.0f} mm apart",
        f"{1e3 * GAP:.0f} mm apart, both",
        f"fewer than {FEW_POINTS} points",
    ),
    "docs/concepts.md": (f"along a straight {TRIAL.approach:g} m",),
    "docs/fingers.md": (f"whose {BEST} best grasps", f"{','.join(FOUR.finger_names)} {FOUR.dof}"),
    "docs/hands.md": (f"in {POSTURES:,} random postures",),
    "docs/limits.md": (
        f"{LOWEST[0]} mm at friction 0.8, {LOWEST[1]} mm at friction 0.3",
        f"| {limits.CLOUD_POINTS // 10**6} million, {limits.CLOUD_BYTES // MIB} MB |",
        f"| {EXTENT} |",
        f"each of {limits.LINE_LETTERS} letters and {limits.TEXT_COLUMNS} numbers",
        f"| {MAX_BUDGET} observations |",
        f"| {PLAN_LIMIT:.0f} s and {TRIAL_LIMIT:.0f} s;",
        f"| {limits.HAND_SHAPE_PAIRS:,}; a cylinder",
        f"| {limits.PLY_HEADER_BYTES // 1024} KiB, {limits.PLY_PROPERTIES} properties |",
        f"| {limits.PATH_BYTES} bytes, {limits.NAME_BYTES} bytes |",
    ),
    "docs/planning.md": (
        f"At friction 0.8 grasps are sought from {LOWEST[0]} mm of height",
        f"| `friction_margin` | {SPEC.friction_margin:g} |",
        f"| `flatness` | {SPEC.flatness:g} rad |",
        f"the widest of {', '.join(WIDER)} and {NARROWEST} mm",
        f"the hand's, at least {1e3 * TIP_RADIUS:.0f} mm",
        f"their width and {1e3 * (SEPARATION - 2 * TIP_RADIUS):.0f} mm",
    ),
    "docs/real_camera.md": (f"fewer than {FEW_POINTS} points",),
}
"""Texts of pages with limits and defaults, made of the constants of the code."""
GIVEN = {
    "README.md": ("6 mm", "95 %"),  # a colour of a picture; the intervals
    "docs/closing.md": ("0.5 N", "0.1 m", "5 mm"),
    "docs/clouds.md": ("25 mm",),
    "docs/concepts.md": ("70 mm",),  # of scripts/concepts.py
    "docs/exchange.md": ("90 deg",),
    "docs/faq.md": ("two seconds",),  # the option before it
    "docs/hands.md": ("30 deg", "10 N", "0.5 N", "250 Hz", "1 N", "3 rad", "2 m"),
    "docs/index.md": ("6 mm",),
    "docs/limits.md": ("10 million", "1 million"),
    "docs/planning.md": ("four times",),
    "docs/real_camera.md": ("10 cm", "900 mm", "three times"),  # the picture's grid; examples
}
"""Numbers that nobody measured: of examples, options, rules and pictures."""
BY_TESTS = "docs/promises.md"  # each of its rows has a test
# its table says what each deviation is; docs/results/paper.md has the measurements
OF_THE_PAPER = "docs/paper.md"


def flat(page: str) -> str:
    return " ".join((ROOT / page).read_text("utf-8").split())


def prose(page: str) -> str:
    """Return a page without its commands and programs, but with printed output."""
    text = re.sub(r"```(?!text)\w*\n.*?```", "", (ROOT / page).read_text("utf-8"), flags=re.DOTALL)
    return " ".join(text.split())


@pytest.mark.parametrize("one", table.CLAIMS, ids=lambda one: f"{one.page}: {one.said}")
def test_a_page_still_has_the_text_of_a_claim(one):
    assert one.stands(), (
        f"mend the claim in scripts/claims/{Path(measured.__file__).name}, or the page"
    )


@pytest.mark.parametrize("page", CONSTANTS)
def test_a_page_states_the_limits_and_defaults_of_the_code(page):
    assert [text for text in CONSTANTS[page] if text not in flat(page)] == []


@pytest.mark.parametrize("page", [page for page in GUIDES if page not in (BY_TESTS, OF_THE_PAPER)])
def test_a_guide_has_no_figure_that_is_not_measured_again(page):
    known = [x.said for x in table.CLAIMS if x.page == page] + list(CONSTANTS.get(page, ()))
    text = (
        prose(page)
        if page != "README.md"
        else re.sub(r"A quarter of .*?\|(?= ## Citation)", "", prose(page))
    )
    for said in known:
        text = text.replace(said, "")
    assert sorted(set(FIGURE.findall(text)) - set(GIVEN.get(page, ()))) == []


def test_the_table_of_the_readme_is_that_of_the_results():
    row = re.compile(
        r"^\| (Allegro|Barrett|LEAP|Shadow)[:,] (.*?) \| (\d+ % \[\d+, \d+\]) .*\| (\d+ of \d+) \|$",
        re.MULTILINE,
    )
    shown, kept = (
        row.findall((ROOT / page).read_text("utf-8"))
        for page in ("README.md", "docs/results/lifts.md")
    )
    assert len(shown) >= 4 and shown == kept[: len(shown)]


def test_claims_end_with_1_where_one_does_not_hold(monkeypatch, capsys):
    right = table.Claim("README.md", "# torchgrasp", lambda: ("so", True))
    gone = right._replace(said="no such text")
    broken = right._replace(check=lambda: (str(1 / 0), True))
    monkeypatch.setattr(run, "CLAIMS", [right])
    run.claims()
    assert "| README.md | # torchgrasp | so (run: 0 s) | yes |" in capsys.readouterr().out
    monkeypatch.setattr(run, "CLAIMS", [right, gone, broken])
    with pytest.raises(SystemExit):
        run.claims()
    said = capsys.readouterr().out
    assert (
        said.endswith("1 of 3 hold\n") and "says so no more" in said and "ZeroDivisionError" in said
    )


RESULTS = sorted((ROOT / "docs" / "results").glob("*.md"))
COMMAND = re.compile(r"`((?:scripts/\w+\.py|torchgrasp|pytest)\b[^`]*)`(.{0,40})", re.DOTALL)


@pytest.mark.parametrize(
    "path", [path for path in RESULTS if path.stem != "index"], ids=lambda path: path.stem
)
def test_each_table_of_results_names_machine_command_and_commit(path):
    text = path.read_text("utf-8")
    assert re.search(r"AMD|Intel|NVIDIA|threads", text)
    head, *sections = re.split(r"^## ", text, flags=re.MULTILINE)
    for section in sections or [head]:
        if "| --- |" in section:
            title = section.splitlines()[0]
            assert re.search(r"\b[Cc]ommits? [0-9a-f]{7}", section + head), title
            assert COMMAND.search(section + head), title


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.stem)
def test_commands_of_results_exist_and_take_their_flags(path):
    for words, after in COMMAND.findall(path.read_text("utf-8")):
        script, *rest = words.split()
        flags = {x for x in rest if x.startswith("--")}
        if "at commit" in after or script == "pytest" or words == "torchgrasp --help":
            continue
        if script == "torchgrasp":
            assert any(words.startswith(f"torchgrasp {name}") for name in COMMANDS), words
        else:
            assert (ROOT / script).is_file(), words
        if script == "scripts/bench.py" and rest[0] != "NAME":
            assert {x[2:] for x in flags} <= {
                field.name for field in dataclasses.fields(Options)
            }, words
        if script == "scripts/reproduce.py":
            assert f'"{rest[0]}": ' in (ROOT / script).read_text("utf-8"), words
