"""scripts/survey.py counts what it says; scripts/sensitivity.py finds constants and fields."""

import doctest

import pytest
import sensitivity
import survey

SOURCE = '''"""Docstring."""
import dataclasses

REACH = 0.02  # how far [m]


@dataclasses.dataclass(frozen=True)
class ClosingNumbers:
    """Numbers of a closing."""

    lead: float = 0.25
    # tries before the hand gives up
    tries: int = 12
    off: int = 0


CLOSING = ClosingNumbers(lead=0.3)


def close(a, b=7.5):
    # a comment
    a, b = b, a
    first, second = sorted((a, b))

    def inner():
        return 0.35 * first

    return inner() + 12 * second + 2.0 + 3
'''


def test_examples_hold():
    assert doctest.testmod(survey).failed == 0


def test_counts_of_a_file():
    found = survey.count(SOURCE)
    assert (found.packed, found.numbers) == (1, 2)  # 0.35 and 12; defaults are no body
    code = [line for line in SOURCE.splitlines() if line.strip()]
    assert found.lines == len(code) - 4  # without two docstrings and two comments


def test_a_report_names_what_occurs_twice(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "row.py").write_text("class Row: pass\n")
        (tmp_path / name / "__init__.py").write_text('__all__ = ["Row"]\n')
    told = survey.report(tmp_path)
    assert "1 file names that occur twice\n  row.py: a/row.py, b/row.py" in told
    assert "1 class names" in told and "1 public names in two lists" in told


def test_constants_and_fields_of_options_values_are_moved(tmp_path, monkeypatch):
    monkeypatch.setattr(sensitivity, "ROOT", tmp_path)
    path = tmp_path / "torchgrasp" / "control" / "closing.py"
    path.parent.mkdir(parents=True)
    path.write_text(SOURCE)
    found = {x.name: x for x in sensitivity.numbers_of(path)}
    assert set(found) == {"REACH", "ClosingNumbers.lead", "ClosingNumbers.tries", "CLOSING"}
    assert {x.module for x in found.values()} == {"torchgrasp.control.closing"}
    for name, moved in (("ClosingNumbers.lead", 0.3), ("ClosingNumbers.tries", 14)):
        loader = sensitivity.Moved("closing", str(path))
        loader.numbers = [found[name]]
        loader.factor = 1.2
        content: dict = {"__name__": "closing"}
        exec(loader.get_code("closing"), content)
        assert abs(getattr(content["ClosingNumbers"](), name.split(".")[1]) - moved) < 1e-12


@pytest.mark.parametrize("acting", [(), (3,), (0, 1, 2, 19), tuple(range(20))])
def test_groups_of_moved_numbers_find_each_that_acts(monkeypatch, acting):
    numbers = [sensitivity.Number("m", f"x{k}", k, 0) for k in range(20)]
    sizes = []

    def in_child(group, factor, case):
        sizes.append(len(group))
        return "other" if any(number.line in acting for number in group) else "before"

    monkeypatch.setattr(sensitivity, "in_child", in_child)
    found = sensitivity.that_change(numbers, 1.2, sensitivity.Case("", str), "before")
    assert [number.line for number in found] == list(acting)
    assert max(sizes) <= sensitivity.TOGETHER
