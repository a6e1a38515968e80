"""The folder in which agents' files are: no tool reads or writes outside it."""

import dataclasses
from pathlib import Path

from torchgrasp.app.cli.inputs import object_name
from torchgrasp.data.shipped import DATA, find_view, list_objects
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import check_path
from torchgrasp.hand.load import list_hands


@dataclasses.dataclass(frozen=True)
class Workplace:
    """The folder of all files that tools read and write; `root` is its path without links.

    Arguments of tools name files by a path below it. The names of shipped hands and objects are
    allowed, too.
    """

    root: Path

    @classmethod
    def at(cls, folder: Path) -> "Workplace":
        """Return the workplace of a folder; raise `BadArgument` if there is no such folder."""
        if not folder.is_dir():
            raise BadArgument("--folder", folder, "a folder that exists")
        return cls(folder.resolve())

    def place(self, name: str, text: str) -> Path:
        """Return the path below the folder that a text names, whether it exists or not.

        Raises `BadArgument`, which calls the argument by `name`, for a path out of the folder.
        Raises it also for `..`, and for a link that leads out of it.
        """
        check_path(name, text)
        path = self.root / text
        try:
            inside = path.resolve().is_relative_to(self.root)
        except (OSError, RuntimeError):  # a link that leads to itself
            inside = False
        if not inside or ".." in path.parts:
            wanted = f"a path below {self.root}, without .. and without a link out of it"
            raise BadArgument(name, repr(text), wanted)
        return path

    def file(self, name: str, text: str) -> Path:
        """Return the path of a file below the folder; raise `BadArgument` if there is none."""
        path = self.place(name, text)
        if not path.is_file():
            raise BadArgument(name, repr(text), f"a file below {self.root}")
        return path

    def cloud(self, name: str, text: str) -> Path:
        """Return the path of a cloud below the folder, or of the view of a shipped object."""
        return find_view(Path(text)) if text in list_objects() else self.file(name, text)

    def mesh(self, name: str, text: str) -> Path:
        """Return the path of a mesh below the folder, or of the mesh of a shipped object."""
        return DATA / text / "mesh.ply" if text in list_objects() else self.file(name, text)

    def hand(self, name: str, text: str) -> str:
        """Return the name of a shipped hand, or the folder of another hand below this folder.

        Raises `BadArgument` if a link in the hand's folder leads out of this folder.
        """
        if text in list_hands():
            return text
        folder = self.place(name, text)
        for path in folder.rglob("*"):
            self.place(name, str(path.relative_to(self.root)))
        return str(folder)

    def out(self, text: str | None, source: Path) -> Path:
        """Return the folder that results are written to: by default out/ and the object's name."""
        return self.place("out", f"out/{object_name(source)}" if text is None else text)

    def tell(self, path: Path) -> str:
        """Return the path of a file below the folder as an agent names it."""
        return path.relative_to(self.root).as_posix()
