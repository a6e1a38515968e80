"""HTML pages, pictures and 3D files of runs and evaluations, drawn without a display or OpenGL."""

from typing import TYPE_CHECKING

from torchgrasp.foundation.lazy import import_late

if TYPE_CHECKING:
    from torchgrasp.app.report.evaluation_page import write_evaluation
    from torchgrasp.app.report.glb import write_glb
    from torchgrasp.app.report.moving_picture import write_film
    from torchgrasp.app.report.page import write_report
    from torchgrasp.app.report.recording import write_recording
    from torchgrasp.app.report.run_data import Run
    from torchgrasp.app.report.scene_picture import draw_scene
    from torchgrasp.app.report.viewer import show_grasps, write_viewer

__all__ = [
    "Run",
    "draw_scene",
    "show_grasps",
    "write_evaluation",
    "write_film",
    "write_glb",
    "write_recording",
    "write_report",
    "write_viewer",
]

__getattr__ = import_late(
    __name__,
    write_evaluation="evaluation_page",
    write_glb="glb",
    write_film="moving_picture",
    write_report="page",
    write_recording="recording",
    Run="run_data",
    draw_scene="scene_picture",
    show_grasps="viewer",
    write_viewer="viewer",
)
