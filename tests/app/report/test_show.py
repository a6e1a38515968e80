"""A 3D page of grasps, opened from Python."""

from torchgrasp import load_object
from torchgrasp.app.report import show_grasps
from torchgrasp.data import load_shipped_grasp


def test_grasps_are_shown_in_the_browser_on_a_page_that_is_whole(monkeypatch):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    path = show_grasps(load_object("jug").view.points.numpy(), load_shipped_grasp("jug", "barrett"))
    assert opened == [path.as_uri()] and path.read_text().rstrip().endswith("</html>")
