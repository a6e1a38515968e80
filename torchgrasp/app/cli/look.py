"""The commands `torchgrasp view`, which opens a 3D page, and `torchgrasp objects`, which lists the
shipped objects.
"""

import webbrowser
from pathlib import Path

from torchgrasp.app.cli.command import Command, arguments, option, positional
from torchgrasp.app.report.run_data import VIEW
from torchgrasp.data.shipped import DATA, MASSES, list_objects
from torchgrasp.foundation.errors import BadArgument


@arguments()
class OpenPage(Command):
    """Open the 3D page of a folder that `torchgrasp grasp` wrote, view.html, in the browser."""

    folder: Path = positional(
        "folder that `torchgrasp grasp` wrote, a 3D page, or the name of a folder in out/, as jug"
    )
    no_browser: bool = option(False, "only print the address")

    def run(self) -> int:
        """Print the address of the 3D page and open it in the browser; return the exit code 0.

        Raises `BadArgument` if there is no such page.
        """
        folder = self.folder if self.folder.exists() else "out" / self.folder
        page = folder
        if folder.suffix != ".html":
            page = (folder if folder.is_dir() else folder.parent) / VIEW
        if not page.is_file():
            command = f"`torchgrasp grasp CLOUD --out {self.folder}`"
            wanted = f"a folder that `torchgrasp grasp` wrote with a report: {command}"
            raise BadArgument("FOLDER", f"{self.folder} without {VIEW}", wanted)
        print(page.resolve().as_uri())
        if not self.no_browser and not webbrowser.open(page.resolve().as_uri()):
            print(
                "No browser was found here: open this address on another machine, or copy the "
                "file, which is whole."
            )
        return 0


@arguments()
class ListObjects(Command):
    """List the shipped objects, each with a noisy view and a true mesh."""

    def run(self) -> int:
        """Print name, mass [kg] and files of each shipped object; return the exit code 0."""
        for name in list_objects():
            folder = DATA / name
            print(
                f"{name} ({MASSES[name]:g} kg)\n  view: {folder / 'view.ply'}\n  mesh: "
                f"{folder / 'mesh.ply'}"
            )
        return 0
