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
    """The folder of all files that tools read and write; `root` is its path without symbolic links.

    Arguments of tools name files by a path relative to it. The names of shipped hands and objects
    are allowed, too.
    """

    root: Path

    @classmethod
    def at(cls, folder: Path) -> "Workplace":
        """Return the workplace of a folder; raise `BadArgument` if there is no such folder."""
        if not folder.is_dir():
            raise BadArgument("--folder", folder, "a folder that exists")
        return cls(folder.resolve())

    def place(self, name: str, text: str) -> Path:
        """Return the path below `root` for a path `text` relative to it; it need not exist.

        Raises `BadArgument`, which calls the argument `name`, for a path out of `root`. Raises it
        also for `..`, and for a symbolic link that leads out of `root`.
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
        """Return the path of an existing file below `root`, for a path `text` relative to it.

        Raises `BadArgument`, which calls the argument `name`, if there is no such file.
        """
        path = self.place(name, text)
        if not path.is_file():
            raise BadArgument(name, repr(text), f"a file below {self.root}")
        return path

    def cloud(self, name: str, text: str) -> Path:
        """Return the path of a point cloud: of a file below `root`, or of a shipped object's view.

        `text` is the path relative to `root`, or the object's name. Raises `BadArgument`, which
        calls the argument `name`, if there is no such file.
        """
        return find_view(Path(text)) if text in list_objects() else self.file(name, text)

    def mesh(self, name: str, text: str) -> Path:
        """Return the path of a mesh: of a file below `root`, or of a shipped object.

        `text` is the path relative to `root`, or the object's name. Raises `BadArgument`, which
        calls the argument `name`, if there is no such file.
        """
        return DATA / text / "mesh.ply" if text in list_objects() else self.file(name, text)

    def hand(self, name: str, text: str) -> str:
        """Return the name of a shipped hand, or the path of another hand's folder.

        `text` is this name, or the path of the hand's folder relative to `root`. Raises
        `BadArgument`, which calls the argument `name`, for a path out of `root`. Raises it also if
        a symbolic link in the hand's folder leads out of `root`.
        """
        if text in list_hands():
            return text
        folder = self.place(name, text)
        for path in folder.rglob("*"):
            self.place(name, str(path.relative_to(self.root)))
        return str(folder)

    def out(self, text: str | None, source: Path) -> Path:
        """Return the path of the folder for results, which need not exist.

        `text` is its path relative to `root`. None means out/NAME, where NAME is that of the object
        in the file `source`. Raises `BadArgument` for a path out of `root`.
        """
        return self.place("out", f"out/{object_name(source)}" if text is None else text)

    def tell(self, path: Path) -> str:
        """Return a path below `root` as text for an agent: relative to `root`, with slashes."""
        return path.relative_to(self.root).as_posix()
