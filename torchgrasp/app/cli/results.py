"""Files that `torchgrasp grasp` writes into its folder, and `torchgrasp view`, which opens them."""

import webbrowser
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from torchgrasp.app.report.page import write_report
from torchgrasp.app.report.run import Run
from torchgrasp.app.report.viewer import VIEW, write_viewer
from torchgrasp.errors import BadArgument

GRASPS = "grasps.safetensors"
"""Name of the file of the grasps."""


def write_results(out: Path, run: Run, no_report: bool) -> str:
    """Write the grasps of a run, and its pages unless there shall be none; return the paths as text.

    Raises:
        OutputError: a file cannot be written.
    """
    paths = [out / GRASPS]
    run.grasps.save(paths[0])
    if not no_report:
        paths += [write_report(out / "report.html", run, VIEW), write_viewer(out / VIEW, run)]
    return ", ".join(map(str, paths))


def view(folder: Annotated[Positional[Path], arg(metavar="FOLDER")], /, no_browser: bool = False) -> int:
    """Open the 3D page of a folder that `torchgrasp grasp` wrote: view.html.

    Args:
        folder: folder that `torchgrasp grasp` wrote.
        no_browser: only print the address.
    """
    page = (folder if folder.is_dir() else folder.parent) / VIEW
    if not page.is_file():
        raise BadArgument("FOLDER", f"{folder} without {VIEW}", "a folder that `torchgrasp grasp` wrote with a report")
    print(page.resolve().as_uri())
    if not no_browser:
        webbrowser.open(page.resolve().as_uri())
    return 0
