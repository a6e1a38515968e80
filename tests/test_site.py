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


@pytest.mark.slow
def test_the_site_is_built_whole_and_fetches_nothing_from_elsewhere(tmp_path: Path):
    """One test, since the site takes long to build: `scripts/docs` refuses a dead link itself.

    The command is as people type it: with --quiet, mkdocs counts no warnings.
    """
    words = [str(ROOT / "scripts" / "docs"), "--site-dir", str(tmp_path)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    check_entries(sorted((tmp_path / "api").glob("*.html")))
    # Examples of docstrings are code and no quotes.
    text = (tmp_path / "api" / "torchgrasp.html").read_text()
    assert "&gt;&gt;&gt;" in text and "<blockquote>" not in text
    elsewhere = re.compile(r'<(script|img|link rel="stylesheet")[^>]*(src|href)="https?://')
    for page in tmp_path.rglob("*.html"):
        assert not elsewhere.search(page.read_text()), page


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
