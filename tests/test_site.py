"""The documentation as a site: it builds without a warning, and every public name of a listed
package is in it.
"""

import html
import importlib
import re
import subprocess
from pathlib import Path

import pytest

from torchgrasp import Status

ROOT = Path(__file__).parents[1]
pytest.importorskip("mkdocs")
site_hooks = pytest.importorskip("site_hooks")
APART = {"report": "app.report"}
"""Pages named otherwise than their packages."""
OWN_ROW = re.compile(r'<tr class="doc-section-item">(.*?)</tr>', re.DOTALL)


@pytest.mark.slow
def test_the_site_is_built_whole_and_fetches_nothing_from_elsewhere(tmp_path: Path):
    """One test, since the site takes long to build: `scripts/docs` refuses a dead link itself.

    The command is as people type it: with --quiet, mkdocs counts no warnings.
    """
    words = [str(ROOT / "scripts" / "docs"), "--site-dir", str(tmp_path)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    pages = sorted((tmp_path / "api").glob("*.html"))
    check_entries([page for page in pages if page.stem != "status"])
    for page in pages:
        check_defaults(page.read_text())
    said = (tmp_path / "api" / "status.html").read_text()
    assert all(f"<code>{one.name}</code>" in said for one in Status)
    assert {"arm", "success", "torchgrasp"} <= {page.stem for page in pages}
    # the system's choice of light or dark, and a button
    assert (tmp_path / "index.html").read_text().count('data-md-color-media="(prefers') == 3
    # Examples of docstrings are code and no quotes.
    text = (tmp_path / "api" / "torchgrasp.html").read_text()
    assert "&gt;&gt;&gt;" in text and "<blockquote>" not in text
    elsewhere = re.compile(r'<(script|img|link rel="stylesheet")[^>]*(src|href)="https?://')
    for page in tmp_path.rglob("*.html"):
        assert not elsewhere.search(page.read_text()), page


def check_defaults(page: str) -> None:
    """An argument that has a default in the signature has it in its row, too."""
    for entry in re.split(r'(?=<h\d id="torchgrasp)', page):
        shown = re.findall(r'<div class="[^"]*doc-signature.*?</div>', entry, re.DOTALL)
        signature = html.unescape(" ".join(re.sub("<[^>]+>", "", one) for one in shown))
        for row in OWN_ROW.findall(entry):
            found = re.search(r"<code>(.*?)</code>", row, re.DOTALL)
            assert found is not None
            name = re.sub("<[^>]+>", "", found[1])
            if "required" in row:
                assert "," not in name
                given = rf"\b{re.escape(name)}: (?:[^\[,\n]|\[.*?\])* = "
                assert not re.search(given, signature), name


def test_each_argument_of_a_docstring_gets_a_row_of_its_own():
    text = """Do it.

    Args:
        one: the first.
        two, three: both; see:
            more, than: this.
        **rest: others.

    Returns: four, five: six.
    """
    split = site_hooks.split_arguments(text)
    assert [line.strip() for line in split.splitlines()][3:-3] == [
        "one: the first.",
        "two: both; see:",
        "more, than: this.",
        "three: both; see:",
        "more, than: this.",
        "**rest: others.",
    ]
    assert "Returns: four, five: six." in split
    assert site_hooks.split_arguments("No, arguments: here.") == "No, arguments: here."


def test_shapes_of_a_docstring_keep_their_stars():
    text = "Return points (*b, f, 3) for joints (*b, h).\n\n`f(*x)` does.\n\n>>> f(*x)\n1"
    markdown = pytest.importorskip("markdown")  # of mkdocs
    page = markdown.markdown(site_hooks.fence(text), extensions=["pymdownx.superfences"])
    assert "points (*b, f, 3) for joints (*b, h)." in page and "<em>" not in page
    assert "<code>f(*x)</code>" in page and "\\*" not in page


def test_a_link_to_the_folder_of_examples_leads_to_their_list():
    assert site_hooks._relink("[e](examples)", Path()) == "[e](examples.md)"
    assert site_hooks._relink("[h](../hands)", Path("docs")) == "[h](hands_README.md)"
    listed = site_hooks._list_examples()
    names = [path.name for path in (ROOT / "examples").glob("*.py")]
    assert all(f"[{name}]({name})" in listed for name in names)


def check_entries(pages: list[Path]) -> None:
    """Every public name of a listed package has its entry."""
    entries = {
        last
        for page in pages
        for last in re.findall(r'id="torchgrasp[\w.]*\.(\w+)"', page.read_text())
    }
    for page in pages:
        package = importlib.import_module(
            "torchgrasp"
            if page.stem == "torchgrasp"
            else f"torchgrasp.{APART.get(page.stem, page.stem)}"
        )
        # constants and aliases of types have no docstring that Python keeps
        named = {
            name for name in package.__all__ if getattr(getattr(package, name), "__doc__", None)
        }
        assert named <= entries, (page.stem, named - entries)
