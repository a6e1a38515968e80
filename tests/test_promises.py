"""What docs/promises.md promises, and the tests that carry the ids of its promises."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
IDS = {
    f"{letter}{k}" for letter, most in {"I": 13, "H": 6, "F": 9, "L": 7, "N": 16}.items() for k in range(1, most + 1)
}
"""Every id that is known: promised, or told why not."""


def promised() -> dict[str, set[str]]:
    """Return the tests that the page names for each id."""
    rows = re.findall(r"^\| ([A-Z]\d+) \| .* \| (.*) \|$", (ROOT / "docs" / "promises.md").read_text(), re.MULTILINE)
    return {name: set(re.findall(r"`([^`]*::[^`]*)`", tests)) for name, tests in rows if "::" in tests}


def marked() -> dict[str, set[str]]:
    """Return the tests that carry each id."""
    found: dict[str, set[str]] = {}
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        place = path.relative_to(ROOT / "tests").as_posix()
        for test in ast.parse(path.read_text()).body:
            for mark in test.decorator_list if isinstance(test, ast.FunctionDef) else ():
                if isinstance(mark, ast.Call) and ast.unparse(mark.func) == "pytest.mark.promise":
                    for name in map(ast.literal_eval, mark.args):
                        found.setdefault(name, set()).add(f"{place}::{test.name}")
    return found


def test_every_promise_has_the_tests_that_the_page_names():
    assert promised() == marked()


def test_every_id_is_promised_or_has_its_reason():
    text = (ROOT / "docs" / "promises.md").read_text()
    reasons = re.findall(r"^\| ([A-Z])(\d+)(?: to [A-Z](\d+))? \|", text[text.index("## Not promised") :], re.MULTILINE)
    told = {f"{letter}{k}" for letter, first, last in reasons for k in range(int(first), int(last or first) + 1)}
    assert set(promised()) | told == IDS and not set(promised()) & told
