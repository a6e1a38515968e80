"""What docs/promises.md promises, and the tests that carry the ids of its promises."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
IDS = {
    f"{letter}{k}" for letter, most in {"I": 13, "H": 6, "F": 9, "L": 7, "N": 16}.items() for k in range(1, most + 1)
}
"""Every id that is known: promised, or told why not."""


def promised() -> set[str]:
    """Return the ids of the promises on the page."""
    text = (ROOT / "docs" / "promises.md").read_text()
    return set(re.findall(r"^\| ([A-Z]\d+) \| ", text[: text.index("## Not promised")], re.MULTILINE))


def marked() -> set[str]:
    """Return the ids that tests carry."""
    found = set[str]()
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        for test in ast.parse(path.read_text()).body:
            for mark in test.decorator_list if isinstance(test, ast.FunctionDef) else ():
                if isinstance(mark, ast.Call) and ast.unparse(mark.func) == "pytest.mark.promise":
                    found.update(map(ast.literal_eval, mark.args))
    return found


def test_every_promise_has_a_test_and_every_mark_a_promise():
    assert promised() == marked()


def test_every_id_is_promised_or_has_its_reason():
    text = (ROOT / "docs" / "promises.md").read_text()
    reasons = re.findall(r"^\| ([A-Z])(\d+)(?: to [A-Z](\d+))? \|", text[text.index("## Not promised") :], re.MULTILINE)
    told = {f"{letter}{k}" for letter, first, last in reasons for k in range(int(first), int(last or first) + 1)}
    assert promised() | told == IDS and not promised() & told
