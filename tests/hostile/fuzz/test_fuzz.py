"""Mutated files of every kind: each is read, or refused by name, in little time and memory.

`--hypothesis-profile=long` tries 100,000 of each kind, other ones in every run.
"""

import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from tests.hostile.fuzz import cases as strange
from tests.hostile.fuzz import own
from tests.hostile.fuzz.mutations import edits, limited, mutated
from torchgrasp.app.author.draft import draft_hand
from torchgrasp.foundation.errors import GraspError

KINDS = {make.__name__: make for make in (*strange.MAKERS, *own.MAKERS)}
MOST_LETTERS = 2000
"""Longest message of an error: it shows a part of what was found."""
SLOWNESS = {"published": 10}
"""Kinds that are read so many times slower than others, and tried so many times less often: mending
takes 20 ms.
"""


@pytest.mark.promise("H5")
@pytest.mark.parametrize("kind", KINDS)
def test_mutated_files_are_read_or_refused_by_name(kind, tmp_path, claw):
    folder = tmp_path / kind
    if kind in ("urdfs", "published", "tomls"):
        (claw.parent / "hand.toml").write_text(draft_hand(claw))
        claw.parent.rename(folder)
    else:
        folder.mkdir()
    cases = KINDS[kind](folder)
    for case in cases:
        case.read(case.path)

    @settings(max_examples=settings.default.max_examples // SLOWNESS.get(kind, 1))
    @given(st.sampled_from(range(len(cases))), edits())
    def check(number, changes):
        case = cases[number]
        told = ""
        content = mutated(case.good, changes)
        case.path.write_bytes(content)
        try:
            with limited():
                case.read(case.path)
            event(f"{case.path.name}: read")
        except GraspError as error:
            told = str(error)
            event(f"{case.path.name}: refused")
        finally:
            case.path.write_bytes(case.good)
        assert len(told) < MOST_LETTERS

    check()
