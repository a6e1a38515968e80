"""Hands by their name in the package robot_descriptions, which downloads the repository of their
maker once.
"""

import importlib
import importlib.util
from pathlib import Path

from torchgrasp.foundation.errors import BadArgument, MissingExtra

MOST_ERROR = 300  # of the message of a failed download [characters]


def locate_urdf(
    name: Path, meshes: Path | None, out: Path | None
) -> tuple[Path, Path | None, Path | None]:
    """Return the path of a hand's URDF or MJCF, the folder of its meshes, and the folder to write.

    `name` is such a file, or a name in the package robot_descriptions, such as allegro_hand. For a
    file, the three arguments are returned unchanged. For a name, its description is downloaded.
    Then `meshes` of None becomes the downloaded folder, and `out` of None becomes `name`.

    Raises `BadArgument` for a name that the package lacks, and for a description without URDF and
    MJCF. It is also raised for a failed download. Raises `MissingExtra` if the package is not
    installed.
    """
    if name.exists() or name.suffix or not str(name).isidentifier():
        return name, meshes, out
    if importlib.util.find_spec("robot_descriptions") is None:
        raise MissingExtra("robot_descriptions", "robots")
    module = f"robot_descriptions.{str(name).removesuffix('_description')}_description"
    if importlib.util.find_spec(module) is None:
        raise BadArgument(
            "urdf", name, "a URDF file, or a name of robot_descriptions such as allegro_hand"
        )
    try:
        found = vars(importlib.import_module(module))
    except Exception as error:  # git raises its own
        wanted = "a network, or a clone in the folder $ROBOT_DESCRIPTIONS_CACHE"
        failed = f"{name}, which cannot be downloaded ({error})"[:MOST_ERROR]
        raise BadArgument("urdf", failed, wanted) from error
    others = {key: value for key, value in found.items() if key.startswith("URDF_PATH_")}
    file = found.get("URDF_PATH") or found.get("MJCF_PATH")
    if file is None:
        raise BadArgument("urdf", f"{name} without a URDF", "a description with URDF or MJCF")
    for key, path in others.items():
        print(f"note: {name} also has {key}: {path}")
    return Path(file), meshes or Path(found["REPOSITORY_PATH"]), out or Path(name)
