"""MJCF files as URDFs: MuJoCo's own compiler reads the file, and the model is written as a URDF.

So default classes, units of angles, frames and missing inertias mean what they mean in MuJoCo. All
checks and repairs are then those of a URDF.
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from torchgrasp.app.author.mjcf_hand import ModelHand
from torchgrasp.app.author.mjcf_text import read_mjcf_text
from torchgrasp.app.author.mjcf_urdf import UrdfWriter
from torchgrasp.files import write_file
from torchgrasp.foundation.errors import HandFileError, one_line
from torchgrasp.foundation.limits import HAND_LINKS
from torchgrasp.hand.urdf import Urdf, read_published
from torchgrasp.sim.mujoco_scene import import_mujoco


class FromMjcf(NamedTuple):
    """An MJCF, a model file of MuJoCo, as a URDF.

    Attributes:
        urdf: the URDF.
        tips: names of the links with a site whose name contains "tip"; () if these are not three to
            five.
        told: sentences for the user on how the URDF was made, such as bodies that are left out.
        warnings: sentences for the user on what the URDF lacks and the hand may need. These are
            limits on sums of joints, and tendons without a motor.
    """

    urdf: Urdf
    tips: tuple[str, ...]
    told: tuple[str, ...]
    warnings: tuple[str, ...]


def read_mjcf(
    path: Path,
    folder: Path,
    root: str,
    tips: Sequence[str],
    visual: bool,
    meshes: Path | None,
) -> FromMjcf:
    """Return an MJCF, a model file of MuJoCo, as a URDF, whose meshes are written to `folder`.

    All files of the MJCF lie below the folder `meshes`; None means the folder of the MJCF. `root`
    names a body of the hand, if the file has several hands; "" if not. `tips` are names of sites or
    bodies that the user chose as fingertips. With `visual`, bodies without collision geoms take
    their visual ones.

    Raises `HandFileError` for a file that is malformed or too large. Raises it also for ball joints
    and other parts that no URDF can hold. Raises `BadArgument` for an unknown `root`, and
    `MissingExtra` if MuJoCo is not installed.
    """
    mujoco = import_mujoco()
    safe = read_mjcf_text(path, meshes)
    refuse = functools.partial(HandFileError, "mjcf")
    try:
        model = mujoco.MjModel.from_xml_string(safe.text, safe.meshes)
    except ValueError as error:
        said = one_line(error)
        raise refuse(f"{path}: {said}", "a file that MuJoCo compiles") from error
    if model.nbody > HAND_LINKS:
        raise refuse(f"{path} of {model.nbody} bodies", f"at most {HAND_LINKS} bodies")
    hand = ModelHand(mujoco, model, path)
    hand.choose(root)
    mechanism = hand.couple()
    writer = UrdfWriter(safe.name, hand, mechanism, hand.drives(mechanism), folder, visual)
    write_file(folder / "hand.urdf", writer.write(tips))
    try:
        urdf = read_published(folder / "hand.urdf", visual)
    except HandFileError as error:
        found = str(error.found).replace(str(folder / "hand.urdf"), str(path))
        raise refuse(found, error.allowed) from error
    # a URDF cannot say that a joint follows a sum
    joints = tuple(
        dataclasses.replace(j, mimic=mechanism.followers.get(j.name)) for j in urdf.joints
    )
    urdf = dataclasses.replace(urdf, path=path, joints=joints)
    if safe.left_out:
        hand.told.append(f"not read: {', '.join(safe.left_out)}")
    begin = f"the MJCF is written as a URDF of {len(urdf.links)} links"
    told = (begin, *hand.told, *mechanism.told)
    return FromMjcf(urdf, hand.tip_links(), told, tuple(hand.warnings))
