"""The turning page as one HTML file that loads nothing."""

import base64
import functools
import hashlib
import json
import re
import zipfile
from importlib import resources
from pathlib import Path

from torchgrasp.app.report.document import escape
from torchgrasp.app.report.run import Run
from torchgrasp.app.report.turning.contents import describe
from torchgrasp.checks import checked
from torchgrasp.files import write_file

VIEW = "view.html"
"""Name of the page beside the report."""

STYLE, SCENE, PANEL = (
    Path(__file__).with_name(name).read_text(encoding="utf-8") for name in ("page.css", "scene.js", "panel.js")
)
SCRIPT = f'(() => {{\n"use strict";\n{SCENE}{PANEL}}})();\n'
"""The two files are one function, so that no name of theirs meets one of the library."""


@checked
def write_viewer(path: Path | str, run: Run) -> Path:
    """Write a run as one HTML page that turns under the mouse, atomically. It needs no network, but WebGL.

    It shows the cloud, the surface by its deviation with a shell at k deviations, contacts, the hand in four postures
    for each of the best 20 grasps, and the closing with its forces. The address may name a state, as in
    `view.html#grasp=3&posture=squeeze&sigma=2` or `view.html#tick=50`.

    Raises:
        OutputError: the file cannot be written.

    >>> import tempfile
    >>> from torchgrasp import ContactSpec, fit_shape, load_hand, load_object
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> from torchgrasp.shape import extract_surface
    >>> view, hand, grasp = load_object("jug").view, load_hand("barrett"), load_shipped_grasp("jug", "barrett")
    >>> surface = extract_surface(fit_shape(view), 24)
    >>> run = Run("jug", Path("jug.ply"), view, hand, ContactSpec(), surface, grasp, ())
    >>> write_viewer(Path(tempfile.mkdtemp(), "view.html"), run).stat().st_size < 8 * 2**20
    True
    """
    return write_file(path, format_viewer(run))


def format_viewer(run: Run) -> str:
    """Return the turning page of a run as text."""
    contents = describe(run)
    # "<" would end the block of data early; within JSON it stands only in texts.
    data = json.dumps(contents, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    scripts = (three(), SCRIPT)
    hashes = " ".join(f"'sha256-{_digest(script)}'" for script in scripts)
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {hashes}"
    return (
        f'<!doctype html>\n<html lang="en">\n<head><meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f'<link rel="icon" href="data:,"><title>{escape(contents["title"])}</title>'
        f"<style>\n{STYLE}</style></head>\n<body>\n"
        f'<main id="stage"></main>\n<aside id="panel"></aside>\n'
        f'<script type="application/json" id="data">{data}</script>\n'
        + "\n".join(f"<script>{script}</script>" for script in scripts)
        + "\n</body>\n</html>\n"
    )


@functools.cache
def three() -> str:
    """Return three.js with its trackball, from the viewer that trimesh ships; its own start is left out."""
    archive = resources.files("trimesh") / "resources" / "templates" / "viewer.zip"
    with archive.open("rb") as file, zipfile.ZipFile(file) as opened:
        template = opened.read("viewer.html.template").decode("utf-8")
    scripts = "\n".join(re.findall(r"<script[^>]*>(.*?)</script>", template, re.DOTALL))
    # Browsers read line ends as \n before they compare a script with its digest.
    library = re.sub(r"init\(\);\s*$", "", re.sub(r"\r\n?", "\n", scripts))
    if "TrackballControls" not in library or "init();" in library[-100:]:
        raise RuntimeError("the installed trimesh ships another viewer than that of trimesh 4.5 to 5.2")
    return library


def _digest(script: str) -> str:
    """Return the SHA-256 of a script as a policy names it."""
    return base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")
