"""The page of an evaluation: every number of the summary is on it, and no text of a file becomes HTML."""

import re

import pytest

from tests.scores import SCORES
from torchgrasp.app.report.evaluation import draw_bar, format_evaluation, write_evaluation
from torchgrasp.evaluation.intervals import share_over


def test_page_shows_shares_objects_and_reasons(tmp_path):
    page = format_evaluation("Grasps <now>", {"protocol": "quick"}, SCORES)
    for text in ("Grasps &lt;now&gt;", "25.0%", "an &lt;open&gt; surface", "1 / 2", "bad_object", "quick"):
        assert text in page
    assert "<open>" not in page and "<script" not in page and " src=" not in page
    assert page.count("<svg") == 3 + 3  # three shares and three objects
    assert write_evaluation(tmp_path / "page.html", "Grasps <now>", {"protocol": "quick"}, SCORES).read_text() == page


def test_a_bar_ends_where_the_interval_does():
    found = share_over({"tin": (1, 4), "cup": (2, 6)})
    ends = [float(x) for x in re.findall(r'x[12]="([\d.]+)"', draw_bar(found, 180))[2:]]
    at = float(re.findall(r'cx="([\d.]+)"', draw_bar(found, 180))[0])
    for drawn, value in zip((*ends, at), (found[1], found[2], found[0]), strict=True):
        assert (drawn - 4) / (180 - 8) == pytest.approx(value, abs=1e-3)
