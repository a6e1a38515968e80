"""Hooks of the documentation site: pages from outside `docs/`, the table of statuses, and how
docstrings are shown.
"""

import ast
import base64
import json
import re
from pathlib import Path
from typing import Any

import griffe
from mkdocs.structure.files import File, Files

from torchgrasp.foundation.errors import Status

ROOT = Path(__file__).resolve().parents[1]
OUTSIDE = {
    "README.md": "readme.md",
    "CHANGELOG.md": "CHANGELOG.md",
    "CONTRIBUTING.md": "CONTRIBUTING.md",
    "SECURITY.md": "SECURITY.md",
    "LICENSE": "LICENSE.md",
    "hands/README.md": "hands_README.md",
    "scripts/README.md": "scripts_README.md",
    "examples": "examples.md",
    "examples/ros2/README.md": "examples_ros2.md",
    "examples/lerobot_robot_torchgrasp/README.md": "examples_lerobot.md",
    **{
        f"examples/{path.name}": f"examples_{path.stem}.md"
        for path in sorted((ROOT / "examples").iterdir())
        if path.suffix in (".py", ".ipynb")
    },
}
"""Files of the project that are pages of the site, and their names there."""

WORKER = "https://unpkg.com/iframe-worker/shim"
"""The script that the offline plugin names, and `docs/assets/worker.js` replaces."""

STATUSES = "<!-- statuses -->"
"""The place of the table of statuses in a page."""

LINK = re.compile(r"\]\(([^)#:]+)(#[^)]*)?\)")
"""A link or a picture of this project; those with a colon lead elsewhere."""


def on_files(files: Files, config: Any) -> Files:
    """Add the files of `OUTSIDE` to the site's files as pages, with their links rewritten."""
    for path, name in OUTSIDE.items():
        if (ROOT / path).is_dir():
            text = _list_examples()
        else:
            text = (ROOT / path).read_text(encoding="utf-8")
        folder = Path(path) if (ROOT / path).is_dir() else Path(path).parent
        if path.endswith(".py"):
            text = f"# {path}\n\n```python\n{text}```\n"
        elif path.endswith(".ipynb"):
            text, pictures = _notebook(text, Path(path).stem)
            for picture, png in pictures.items():
                files.append(File.generated(config, picture, content=png))
        files.append(File.generated(config, name, content=_relink(text, folder)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Return the Markdown of a page in docs/ with the table of statuses and with links of the site.

    Links to files outside docs/ lead to the pages of these files.
    """
    if page.file.generated_by:
        return markdown
    markdown = markdown.replace(STATUSES, list_statuses())
    folder = Path("docs", page.file.src_uri).parent
    return _relink(markdown, folder, "../" * (len(folder.parts) - 1))


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """Return a page's HTML in which the script for the offline search is loaded from the site.

    Otherwise it would be loaded from another server.
    """
    up = "../" * page.url.count("/")
    return output.replace(WORKER, f"{up}assets/worker.js")


def on_post_template(output_content: str, **_: Any) -> str:
    """Return the HTML of the page for dead links, with the script for the search from the site."""
    return output_content.replace(WORKER, "/assets/worker.js")


def list_statuses() -> str:
    """Return a Markdown table of all members of `Status`: code, name and meaning."""
    rows = [f"| {int(one)} | `{one.name}` | {one.sentence} |" for one in sorted(Status)]
    return "\n".join(["| code | name | meaning |", "| --- | --- | --- |", *rows])


def _list_examples() -> str:
    """Return a page with the first sentence of each example, and links, as Markdown."""
    lines = ["# Examples", "", "| file | what it shows |", "| --- | --- |"]
    for path in sorted((ROOT / "examples").glob("*.py")):
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        first = " ".join(text.split("\n\n")[0].split())
        lines.append(f"| [{path.name}]({path.name}) | {first} |")
    lines += [
        "| [tutorial.ipynb](tutorial.ipynb) | A notebook: from one noisy view to a held object. |",
        "| [ros2](ros2/README.md) | A package of ROS 2 nodes. |",
    ]
    return "\n".join(lines)


def _notebook(text: str, stem: str) -> tuple[str, dict[str, bytes]]:
    """Return a notebook with its outputs as Markdown, and its pictures by their names."""
    parts = list[str]()
    pictures = dict[str, bytes]()
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", []):
            shown = {key: "".join(x) for key, x in output.get("data", {}).items()}
            if "image/png" in shown:
                name = f"examples_{stem}_{len(pictures) + 1}.png"
                pictures[name] = base64.b64decode(shown["image/png"])
                parts.append(f"![What the cell draws]({name})")
            elif "text/html" in shown:
                parts.append(shown["text/html"])
            else:
                said = shown.get("text/plain") or "".join(output.get("text", []))
                parts.append(f"```text\n{said.rstrip()}\n```")
    return "\n\n".join(parts), pictures


def _relink(text: str, folder: Path, up: str = "") -> str:
    """Replace links from a file in a folder of the project by links of the site. `up` leads to the
    site's root.
    """

    def replace(match: re.Match[str]) -> str:
        target = (ROOT / folder / match[1]).resolve()
        if not target.is_relative_to(ROOT):
            return match[0]
        path = target.relative_to(ROOT).as_posix()
        inside = path.removeprefix("docs/") if path.startswith("docs/") else OUTSIDE.get(path)
        if inside is None and target.is_dir():  # the site has files alone
            inside = OUTSIDE.get(f"{path}/README.md", "readme.md")
        return match[0] if inside is None else f"]({up}{inside}{match[2] or ''})"

    return LINK.sub(replace, text)


class FenceExamples(griffe.Extension):
    """An extension of griffe that fences `>>>` blocks of docstrings.

    Markdown would take them for quotes.
    """

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring of an object by `fence`."""
        if obj.docstring is not None:
            obj.docstring.value = fence(obj.docstring.value)


ARGUMENTS = re.compile(r"^( +)(\w+(?:, \w+)+): (.*(?:\n\1 +\S.*)*)", re.MULTILINE)
"""An entry of a docstring's "Args:" that documents several arguments."""


class OneRowEach(griffe.Extension):
    """An extension of griffe that gives each argument of a docstring a row of its own.

    A row of several arguments would show neither types nor defaults.
    """

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        """Rewrite the docstring of a function by `split_arguments`."""
        if func.docstring is not None:
            func.docstring.value = split_arguments(func.docstring.value)


def split_arguments(text: str) -> str:
    """Return a docstring in which each entry of "Args:" documents one argument.

    An entry "a, b: words" becomes two entries with the same words.
    """
    start = text.find("Args:\n")
    if start < 0:
        return text
    end = text.find("\n\n", start)
    end = len(text) if end < 0 else end

    def each(match: re.Match[str]) -> str:
        return "\n".join(f"{match[1]}{name}: {match[3]}" for name in match[2].split(", "))

    return text[:start] + ARGUMENTS.sub(each, text[start:end]) + text[end:]


STAR = re.compile(r"`[^`]*`|\(\*(?=\w)")
"""Code, or the first star of a shape such as (*b, 3)."""


def fence(text: str) -> str:
    """Return a docstring whose examples are fenced, and whose shapes keep their stars.

    Markdown takes the text between the stars of two shapes for emphasis.
    """
    blocks = re.split(r"\n{2,}", text)
    return "\n\n".join(
        f"```pycon\n{b}\n```" if b.lstrip().startswith(">>> ") else STAR.sub(_escape, b)
        for b in blocks
    )


def _escape(match: re.Match[str]) -> str:
    """Return code as it is, and the beginning of a shape with its star escaped."""
    return match[0] if match[0].startswith("`") else r"(\*"
