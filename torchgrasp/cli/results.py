"""What `torchgrasp grasp` leaves in its folder: the grasps, the report and the page that turns."""

from pathlib import Path

from torchgrasp.report.page import write_report
from torchgrasp.report.run import Run
from torchgrasp.report.turning import VIEW, write_viewer


def write_results(out: Path, run: Run, no_report: bool) -> str:
    """Write the grasps of a run, and its pages unless there shall be none; return the paths as text.

    Raises:
        OutputError: a file cannot be written.
    """
    paths = [out / "grasps.safetensors"]
    run.grasps.save(paths[0])
    if not no_report:
        paths += [write_report(out / "report.html", run, VIEW), write_viewer(out / VIEW, run)]
    return ", ".join(map(str, paths))
