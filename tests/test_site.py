"""The documentation as a site: it builds without a warning, and every public name of a listed
package is in it.
"""

import importlib
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
pytest.importorskip("mkdocs")
APART = {"report": "app.report"}
"""Pages named otherwise than their packages."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built by `scripts/docs`: a dead link is an error."""
    folder = tmp_path_factory.mktemp("site")
    words = [str(ROOT / "scripts" / "docs"), "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_every_public_name_has_its_entry(site: Path):
    pages = sorted((site / "api").glob("*.html"))
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


def test_examples_of_docstrings_are_code_and_no_quotes(site: Path):
    text = (site / "api" / "torchgrasp.html").read_text()
    assert "&gt;&gt;&gt;" in text and "<blockquote>" not in text


def test_nothing_is_fetched_from_elsewhere(site: Path):
    for page in site.rglob("*.html"):
        assert not re.search(
            r'<(script|img|link rel="stylesheet")[^>]*(src|href)="https?://', page.read_text()
        ), page
