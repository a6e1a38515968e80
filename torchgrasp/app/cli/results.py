"""What `torchgrasp grasp` leaves in its folder, grasps and pages; `torchgrasp view` opens them live."""

import importlib.util
import time
import webbrowser
from pathlib import Path
from typing import Annotated

from jaxtyping import Float
from torch import Tensor
from tyro.conf import Positional, arg

from torchgrasp.app.cli.common import AS_IT_IS, ViewOptions, naming, read_view
from torchgrasp.app.report.page import write_report
from torchgrasp.app.report.run import Run
from torchgrasp.app.report.turning import VIEW, write_viewer
from torchgrasp.base import check_whole
from torchgrasp.errors import BadArgument, MissingExtra
from torchgrasp.hand.load import hand_of
from torchgrasp.planner.provenance import digest
from torchgrasp.scene.file import is_scene, read_scene
from torchgrasp.values import Grasps, load_grasps

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
    cloud: Path | None = None,
    meant: Annotated[ViewOptions, arg(name="")] = AS_IT_IS,
    port: int = 8080,
    no_browser: bool = False,
) -> int:
    """Open grasps live in a browser: cloud, surface, contacts, postures of the hand, the closing; until Ctrl-C.

    It needs the extra "view". It listens on this machine alone; from another one, `ssh -L PORT:localhost:PORT` reaches
    it. Cloud, surface and closing are those of the view.html beside the grasps. Where there is none, as after `grasp
    --no-report`, --cloud shows the cloud with the grasps.

    Args:
        grasps: folder that `torchgrasp grasp` wrote, or a grasps.safetensors of any command.
        hand: name or folder of the hand; by default the name in the file.
        cloud: cloud or scene that the grasps are of, to be shown in place of what view.html holds.
        meant: how the file of the cloud is meant, as for `torchgrasp grasp`.
        port: where it listens; the next that is free, if that is taken.
        no_browser: print the address alone.
    """
    check_whole("--port", port, 1, 65535)
    if importlib.util.find_spec("viser") is None:
        raise MissingExtra("viser", "view")
    from torchgrasp.app.report.turning.contents import describe_grasps
    from torchgrasp.app.report.turning.live import LiveView
    from torchgrasp.app.report.turning.shown import read_page, read_shown

    path = grasps / GRASPS if grasps.is_dir() else grasps
    with naming(path="GRASPS"):
        planned = load_grasps(path)
    with naming(hand="--hand", name="--hand", grasps="GRASPS", fingers="GRASPS"):
        robot = hand_of(planned, hand)
    seen = None if cloud is None else _read_seen(cloud, meant, planned)
    shown = read_shown(describe_grasps(f"Grasps of {path}", robot, planned, seen))
    page = path.with_name(VIEW)
    if cloud is None and page.is_file():
        with naming(path="GRASPS"):
            beside = read_page(page)
        if beside.rows == shown.rows:
            shown = beside
        else:
            print(f"note    {page} shows other grasps than {path}, which are shown alone")
    elif cloud is None:
        print(f"note    no {VIEW} beside {path}: the grasps are shown alone; --cloud FILE shows their cloud, too")
    live = LiveView(shown, port)
    try:
        print(f"{len(shown.rows)} grasps at {live.address} until Ctrl-C", flush=True)
        if not no_browser:
            webbrowser.open(live.address)
        while True:
            time.sleep(3600)
    finally:
        live.stop()


def _read_seen(path: Path, meant: ViewOptions, planned: Grasps) -> Float[Tensor, "n 3"]:
    """Return the points of a scene, or of the cloud that the grasps were planned on; refuse another one."""
    with naming(path="--cloud", points="--cloud"):
        if is_scene(path):
            return read_scene(path).points
    points = read_view("--cloud", path, meant).cloud
    if planned.meta.get("cloud_sha256", digest(points)) != digest(points):
        raise BadArgument("--cloud", f"{path}, not what the grasps were planned on", "that cloud, read as it was then")
    return points.points
