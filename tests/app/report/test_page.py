import base64
import dataclasses
import re
from html.parser import HTMLParser

import pytest

from tests.scores import SCORES
from torchgrasp import __version__, load_scene
from torchgrasp.app.report.evaluation_page import format_evaluation, write_evaluation
from torchgrasp.app.report.page import TEMPLATES, format_page, write_report
from torchgrasp.app.report.run_data import closing_sentence, grasp_rows, refusal, verdict
from torchgrasp.app.report.viewer import write_viewer
from torchgrasp.evaluation.intervals import share_over
from torchgrasp.files import template_engine
from torchgrasp.foundation.errors import OutputError, Status
from torchgrasp.planner.explain import Explanation, Funnel, Losses, Trial
from torchgrasp.values.specs import ContactSpec

PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAQAAAC1HAwCAAAAC0lEQVR42mNkYAAAAAYAAjCB0C8AAAAASUVORK5CYII="
)


class Reader(HTMLParser):
    """Collects tags with their attributes, and the text between them."""

    def __init__(self):
        super().__init__()
        self.tags = []
        self.words = []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.words.append(data)


def read(page):
    reader = Reader()
    reader.feed(page)
    return reader.tags, " ".join(reader.words)


def test_page_is_self_contained_and_escapes_every_text(run):
    tags, words = read(format_page(run, {"Some <i>pictures</i>": [("a 'caption' <b>", PNG)]}))
    names = {tag for tag, _ in tags}
    assert not names & {"script", "link", "iframe", "b", "i", "odd"}
    sources = [value for _, attrs in tags for key, value in attrs.items() if key in ("src", "href")]
    assert sources and all(s.startswith("data:image/png;base64,") for s in sources)
    assert base64.b64decode(sources[0].split(",")[1]) == PNG
    for text in (
        "<odd> & 'quoted'.ply",
        "a <b>bold</b> claim",
        "<script>alert(1)</script>",
        "a 'caption' <b>",
    ):
        assert text in words


def test_page_shows_stages_grasps_statuses_seed_and_units(run):
    _, words = read(format_page(run, {}))
    for text in (
        "321 points",
        "1.2",
        "1.4",
        Status.TIP_ERROR.sentence,
        "tip_error",
        "seed",
        "7",
        "metre, radian",
    ):
        assert text in words
    assert verdict(run) in words


def test_report_is_written_whole_with_pictures(run, tmp_path):
    path = write_report(tmp_path / "deep" / "report.html", run)
    page = path.read_text(encoding="utf-8")
    assert page.startswith("<!doctype html>") and page.endswith("</html>\n")
    assert len(re.findall("data:image/png", page)) == 7
    assert [p.name for p in path.parent.iterdir()] == ["report.html"]


@pytest.mark.parametrize("write", [write_report, write_viewer])
def test_a_page_into_a_file_as_folder_is_refused(run, tmp_path, monkeypatch, write):
    monkeypatch.setattr("torchgrasp.app.report.page.draw_pictures", lambda run: {})
    (tmp_path / "taken").write_text("x")
    with pytest.raises(OutputError):
        write(tmp_path / "taken" / "report.html", run)


def test_grasp_rows_are_in_millimetres_and_degrees(run):
    (row,) = grasp_rows(run.executable)
    assert row == ("1", "73%", "201.00", "4.0", "0", "0.0200", "1.0")


def test_verdicts(run):
    assert (
        verdict(run)
        == "The allegro hand held the ball: lifted 0.10 m, moved 3 mm and 2 deg in the hand."
    )
    dropped = dataclasses.replace(run.closure, held=False, status=Status.DROPPED)
    sentence = closing_sentence(dataclasses.replace(run, closure=dropped))
    assert sentence.endswith(f"did not hold the ball: {Status.DROPPED.sentence}.")
    planned = dataclasses.replace(run, closure=None)
    assert verdict(planned) == "The allegro hand has 1 executable grasp of the ball."
    among = dataclasses.replace(planned, object_name="object 4", scene=load_scene())
    assert verdict(among) == "The allegro hand has 1 executable grasp of object 4."
    assert among.title == "Grasps of object 4 with the allegro hand"
    none = dataclasses.replace(planned, grasps=run.grasps[1])
    assert f"1 of 1 postures: {Status.TIP_ERROR.sentence}" in verdict(none)
    unplanned = dataclasses.replace(none, grasps=run.grasps[:0])
    assert f"2 of 2 starts: {Status.NOT_CLOSED.sentence}" in refusal(unplanned)
    top = float(run.surface.vertices[:, 2].max())
    flat, high = (
        dataclasses.replace(unplanned, spec=ContactSpec(table=top - h)) for h in (0.0051, 0.0066)
    )
    assert refusal(flat).endswith(
        "it is 5 mm high, and this hand needs 6 mm."
    ) and "high" not in refusal(high)
    assert Status.OUT_OF_REACH.sentence in refusal(dataclasses.replace(unplanned, plan=None))
    _, words = read(format_page(none, {}))
    assert "Best grasps" not in words


def test_a_run_without_a_grasp_tells_what_would_help(run):
    lost = Losses("contacts", "starts", 9, {Status.NOT_FLAT: 6, Status.TOO_CLOSE: 3})
    trial = Trial(
        "with <wider> limits", True, 4, 0.15, Funnel((dataclasses.replace(lost, lost={}),))
    )
    explanation = Explanation(9, Funnel((lost,)), (trial,))
    none = dataclasses.replace(
        run, closure=None, mesh=None, grasps=run.grasps[1], explanation=explanation
    )
    assert verdict(none) == f"{refusal(none)} {explanation.advice}" and str(trial) in verdict(none)
    tags, words = read(format_page(none, {}))
    assert "wider" not in {tag for tag, _ in tags}
    for text in ("0 of 9 starts", "6 not_flat, 3 too_close", "with <wider> limits", "15%"):
        assert text in words


def test_the_page_of_an_evaluation_shows_shares_objects_and_reasons_and_no_text_becomes_html(
    tmp_path,
):
    page = format_evaluation("Grasps <now>", {"protocol": "quick"}, SCORES)
    for text in (
        "Grasps &lt;now&gt;",
        "25.0%",
        "an &lt;open&gt; surface",
        "1 / 2",
        "bad_object",
        "quick",
    ):
        assert text in page
    assert "<open>" not in page and "<script" not in page and " src=" not in page
    assert page.count("<svg") == 3 + 3  # three shares and three objects
    assert (
        write_evaluation(
            tmp_path / "page.html", "Grasps <now>", {"protocol": "quick"}, SCORES
        ).read_text()
        == page
    )


def test_settings_of_a_group_have_a_row_each():
    asked = {"hand": "barrett", "protocol": {"name": "quick", "trial": {"max_force": None}}}
    page = format_evaluation("Grasps", asked, SCORES)
    _, words = read(page)
    assert words.split("Settings")[1].split() == (
        "what value hand barrett protocol: name quick protocol: trial: max force -".split()
    )


def test_a_report_says_version_command_and_date_of_its_run(run):
    told = dataclasses.replace(run, command="torchgrasp grasp jug", date="2026-01-02 03:04 UTC")
    page = format_page(told, {})
    for text in (f"torchgrasp {__version__}", "torchgrasp grasp jug", "2026-01-02 03:04 UTC"):
        assert text in page
    assert format_page(told, {}) == page and " UTC" not in format_page(run, {})


def test_the_page_of_an_evaluation_has_no_nan_and_no_success_of_what_was_not_tried():
    """All predictions are right or none: skill and area are not measured, nor is a cause's size."""
    tried = dataclasses.replace(SCORES[0].attempts[0], predicted=0.9)
    lost = dataclasses.replace(tried, passed=False, status=Status.DROPPED, cause="turned")
    for attempts in ((tried,), (lost,), (dataclasses.replace(lost, size=3.0), lost)):
        scores = [dataclasses.replace(SCORES[0], attempts=attempts), *SCORES[1:2], SCORES[3]]
        _, words = read(format_evaluation("Grasps", {}, scores))
        assert not re.search(r"\bnan\b", words, re.IGNORECASE)
        row = words[words.index("sieve") :].split("bad_object")[0]
        assert "0%" not in row and row.split()[1] == "-"


def test_a_bar_ends_where_the_interval_does():
    found = share_over({"tin": (1, 4), "cup": (2, 6)})
    bar = str(template_engine(TEMPLATES).get_template("table.html").module.bar(found))
    ends = [float(x) for x in re.findall(r'x[12]="([\d.]+)"', bar)[2:]]
    at = float(re.findall(r'cx="([\d.]+)"', bar)[0])
    for drawn, value in zip((*ends, at), (found[1], found[2], found[0]), strict=True):
        assert (drawn - 4) / (180 - 8) == pytest.approx(value, abs=1e-3)
