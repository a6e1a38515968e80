"""Write the files of the hands that are authored from tables, and of left hands that mirror a right one."""

from pathlib import Path

from torchgrasp.files import write_file
from torchgrasp.hand.collision_shapes import collision_pairs
from torchgrasp.hand.hand_toml import read_hand_toml
from torchgrasp.hand.load import hands_folder
from torchgrasp.hand.urdf import read_urdf
from train.hands.files import format_toml, format_urdf
from train.hands.leap import leap
from train.hands.mirror import Mirror
from train.hands.shadow import shadow

TABLES = (leap("right"), leap("left"), shadow())
"""Hands that are written from tables."""
MIRRORS = (
    Mirror(("shadow", "shadow_left"), axis=0),
    Mirror(
        ("allegro", "allegro_left"),
        axis=1,
        # Wonik turns the swivels of both hands about +z
        kept=frozenset({"joint_0", "joint_4", "joint_8"}),
    ),
)
"""Left hands that are the mirror images of right ones."""


def hands() -> None:
    """Write hand.urdf and hand.toml of every hand that comes from a table or a mirror."""
    for table in TABLES:
        folder, urdf = hands_folder() / table.name, format_urdf(table)
        folder.mkdir(exist_ok=True)
        same = (folder / "hand.toml").exists() and (folder / "hand.urdf").read_text("utf-8") == urdf
        write_file(folder / "hand.urdf", urdf)
        pairs = list(read_hand_toml(folder / "hand.toml").pairs or ()) if same else meeting_pairs(folder)
        write_file(folder / "hand.toml", format_toml(table, pairs))
        print(folder)
    for image in MIRRORS:
        folder = hands_folder() / image.names[1]
        folder.mkdir(exist_ok=True)
        for name, text in mirrored(image).items():
            write_file(folder / name, text)
        print(folder)


def meeting_pairs(folder: Path) -> list[tuple[str, str]]:
    """Return the pairs of links that can meet, which takes half a minute."""
    urdf = read_urdf(folder / "hand.urdf")
    return collision_pairs(urdf, {j.name: j.mimic for j in urdf.movable if j.mimic is not None})


def mirrored(image: Mirror) -> dict[str, str]:
    """Return the two files of a left hand, by name."""
    right = hands_folder() / image.names[0]
    urdf, toml = ((right / name).read_text("utf-8") for name in ("hand.urdf", "hand.toml"))
    return {"hand.urdf": image.urdf(urdf), "hand.toml": image.toml(toml)}
