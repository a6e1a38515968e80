"""What `torchgrasp grasp` leaves in its folder, grasps and pages; `torchgrasp view` opens them live."""

import importlib.util
import time
import webbrowser
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from torchgrasp.base import check_whole
from torchgrasp.cli.common import naming
from torchgrasp.errors import MissingExtra
from torchgrasp.hand.load import hand_of
from torchgrasp.report.page import write_report
from torchgrasp.report.run import Run
from torchgrasp.report.turning import VIEW, write_viewer
from torchgrasp.values import load_grasps

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


def view(
    grasps: Annotated[Positional[Path], arg(metavar="GRASPS")],
    /,
    hand: str | None = None,
    port: int = 8080,
    no_browser: bool = False,
) -> int:
    """Open grasps live in a browser: cloud, surface, contacts, postures of the hand, the closing; until Ctrl-C.

    It needs the extra "view". It listens on this machine alone; from another one, `ssh -L PORT:localhost:PORT` reaches
    it. Cloud, surface and closing are those of the view.html beside the grasps; without it the grasps are shown alone.

    Args:
        grasps: folder that `torchgrasp grasp` wrote, or a grasps.safetensors of any command.
        hand: name or folder of the hand; by default the name in the file.
        port: where it listens; the next that is free, if that is taken.
        no_browser: print the address alone.
    """
    check_whole("--port", port, 1, 65535)
    if importlib.util.find_spec("viser") is None:
        raise MissingExtra("viser", "view")
    from torchgrasp.report.turning.contents import describe_grasps
    from torchgrasp.report.turning.live import LiveView
    from torchgrasp.report.turning.shown import read_page, read_shown

    path = grasps / GRASPS if grasps.is_dir() else grasps
    with naming(path="GRASPS"):
        planned = load_grasps(path)
    with naming(hand="--hand", name="--hand", grasps="GRASPS", fingers="GRASPS"):
        robot = hand_of(planned, hand)
    shown = read_shown(describe_grasps(f"Grasps of {path}", robot, planned))
    page = path.with_name(VIEW)
    if page.is_file():
        with naming(path="GRASPS"):
            beside = read_page(page)
        if beside.rows == shown.rows:
            shown = beside
        else:
            print(f"note    {page} shows other grasps than {path}, which are shown alone")
    live = LiveView(shown, port)
    try:
        print(f"{len(shown.rows)} grasps at {live.address} until Ctrl-C", flush=True)
        if not no_browser:
            webbrowser.open(live.address)
        while True:
            time.sleep(3600)
    finally:
        live.stop()
