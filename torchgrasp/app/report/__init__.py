"""Pages and pictures of runs, evaluations and hands. No OpenGL, no display."""

from torchgrasp.app.report.evaluation import write_evaluation
from torchgrasp.app.report.page import draw_pictures, write_report
from torchgrasp.app.report.run import Run, Stage, verdict
from torchgrasp.app.report.turning import write_viewer

__all__ = ["Run", "Stage", "draw_pictures", "verdict", "write_evaluation", "write_report", "write_viewer"]
