"""The turning page live: the same scene served by viser, to any browser that reaches its address."""

import contextlib
import io
import time
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from torchgrasp.app.report.document import escape
from torchgrasp.app.report.palette import rgb
from torchgrasp.app.report.turning.contents import POSTURES
from torchgrasp.app.report.turning.shown import Shown, ShownMesh

ARROW, SHAFT, HEAD = 0.035, 0.0012, 0.0035
"""Length of the arrows along normals, and radii of their shafts and heads [m], as in the page."""
DOT = 0.0015
"""Size of a point of a cloud [m]: half of a camera's grid at half a metre."""
AWAY, NEAR = 0.6, 0.01
"""Distances [m] of the first camera from the object, where a hand fills the picture, and of what is cut off."""
RATE = 30.0
"""Pictures a second of a replay."""


class LiveView:
    """A server that shows grasps, until `stop`; `show` does what its panel does.

    Its nodes are /cloud, /others, /surface, /shell, /contacts, /table, /object and /hand with a piece each.

    Args:
        shown: what it shows.
        port: where it listens; the next that is free, if that is taken.
        host: the address of this machine that it listens at.
    """

    def __init__(self, shown: Shown, port: int, host: str = "127.0.0.1") -> None:
        import viser

        self.shown = shown
        with contextlib.redirect_stdout(io.StringIO()):  # its banner; whoever starts this says the address
            self.server = viser.ViserServer(host=host, port=port, label="torchgrasp", verbose=False)
        self.grasp, self.posture, self.sigma, self.tick = 0, "grasp", 0.0, None
        self.hidden: set[str] = set()
        self.nodes: dict[str, Any] = {}
        self._add_scene()
        self._add_panel()
        self.show()

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def stop(self) -> None:
        """Close the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def show(self, **change: Any) -> None:
        """Change the state, and what is seen with it.

        Args:
            change: `grasp` from 0, `posture`, `sigma` deviations of the shell, `tick` of the replay or None.
        """
        for name, value in change.items():
            setattr(self, name, value)
        shown, replay = self.shown, self.shown.replay
        playing = self.tick is not None and replay is not None
        absent = {"shell": playing or self.sigma == 0, "object": not playing}
        absent |= dict.fromkeys(("surface", "cloud", "contacts"), playing)
        with self.server.atomic():
            if playing and replay is not None:
                self._pose(replay.links[self.tick])
                self.nodes["object"].wxyz, self.nodes["object"].position = split(replay.object[self.tick])
            elif shown.rows:
                self._pose(shown.links[self.grasp, POSTURES.index(self.posture)])
                self._touch()
            if shown.surface is not None:
                away = self.sigma * shown.surface.std[:, None] * shown.surface.normals
                self.nodes["shell"].vertices = shown.surface.points + away
            for name, node in self.nodes.items():
                node.visible = not absent.get(name, False) and name not in self.hidden
            self.text.content = paragraph(self._describe())

    def _add_scene(self) -> None:
        """Add all nodes."""
        scene, shown = self.server.scene, self.shown
        scene.set_up_direction("+z")
        seen = shown.points.reshape(-1, 3) if shown.surface is None else shown.surface.points
        middle = (seen.min(0) + seen.max(0)) / 2 if len(seen) else np.zeros(3)
        self.server.initial_camera.look_at = middle
        self.server.initial_camera.position = middle + AWAY * np.array(shown.eye)
        self.server.initial_camera.near = NEAR
        for name, points, color in (("cloud", shown.cloud, "#c2452d"), ("others", shown.others, "#8b929c")):
            if points is not None:
                self.nodes[name] = scene.add_point_cloud(
                    f"/{name}", points, rgb(color), point_size=DOT, precision="float32"
                )
        if shown.surface is not None:
            import trimesh

            surface = shown.surface
            mesh = trimesh.Trimesh(
                surface.points,
                surface.faces,
                vertex_normals=surface.normals,
                vertex_colors=surface.colors,
                process=False,
            )
            self.nodes["surface"] = scene.add_mesh_trimesh("/surface", mesh)
            self.nodes["shell"] = scene.add_mesh_simple(
                "/shell", surface.points, surface.faces, color=rgb("#3b528b"), opacity=0.35, side="double"
            )
        self.nodes["hand"] = scene.add_frame("/hand", show_axes=False)
        self.pieces = [(self._add_mesh(f"/hand/{k}", piece), piece.link) for k, piece in enumerate(shown.hand)]
        self.nodes["contacts"] = scene.add_frame("/contacts", show_axes=False)
        if shown.replay is not None:
            self.nodes["object"] = self._add_mesh("/object", shown.replay.mesh)
        if shown.table is not None:
            self.nodes["table"] = scene.add_cylinder(
                "/table",
                0.4 * AWAY,
                0.001,
                rgb(shown.table),
                radial_segments=96,
                position=(*middle[:2].tolist(), -0.001),
            )

    def _add_mesh(self, name: str, mesh: ShownMesh) -> Any:
        """Add a mesh in its colour."""
        return self.server.scene.add_mesh_simple(name, mesh.points, mesh.faces, color=rgb(mesh.color), side="double")

    def _add_panel(self) -> None:
        """Add what a person clicks; each part calls `show`."""
        gui, shown = self.server.gui, self.shown
        gui.configure_theme(control_layout="fixed", control_width="large")  # beside the scene, not over it
        self.head = gui.add_html(paragraph(f"<b>{escape(shown.title)}</b><br>{escape(shown.verdict)}"))
        if shown.rows:
            names = [f"{row[0]}: {row[1]} likely, margin {row[2]}" for row in shown.rows]
            self.grasps = gui.add_dropdown("grasp", names)
            self.grasps.on_update(lambda _: self.show(grasp=names.index(self.grasps.value), tick=None))
            self.postures = gui.add_dropdown("posture", POSTURES, initial_value=self.posture)
            self.postures.on_update(lambda _: self.show(posture=self.postures.value, tick=None))
        self.text = gui.add_html("")
        if shown.surface is not None:
            most = shown.surface.most_mm
            gui.add_html(paragraph(f"Surface by its standard deviation: dark is 0 mm, yellow {most:.1f} mm."))
            self.shell = gui.add_slider("shell [std]", min=0.0, max=3.0, step=0.1, initial_value=0.0)
            self.shell.on_update(lambda _: self.show(sigma=self.shell.value, tick=None))
        if shown.replay is not None:
            last = len(shown.replay.time) - 1
            self.ticks = gui.add_slider("closing", min=0, max=last, step=1, initial_value=0)
            self.ticks.on_update(lambda _: self.show(tick=self.ticks.value))
            gui.add_button("play").on_click(lambda _: self._play())
        with gui.add_folder("Layers"):
            for name in self.nodes:
                self._add_switch(name)

    def _add_switch(self, name: str) -> None:
        """Add the box that shows or hides a node."""
        box = self.server.gui.add_checkbox(name, True)

        def switch(_: Any) -> None:
            (self.hidden.discard if box.value else self.hidden.add)(name)
            self.show()

        box.on_update(switch)

    def _play(self) -> None:
        """Replay the closing, as fast as it was."""
        assert self.shown.replay is not None
        time_s = self.shown.replay.time
        begin = time.perf_counter()
        while (now := float(time_s[0]) + time.perf_counter() - begin) < time_s[-1]:
            self.ticks.value = int(np.searchsorted(time_s, now))
            time.sleep(1 / RATE)
        self.ticks.value = len(time_s) - 1

    def _pose(self, links: Float[np.ndarray, "l 4 4"]) -> None:
        """Move the pieces of the hand."""
        for node, link in self.pieces:
            node.wxyz, node.position = split(links[link])

    def _touch(self) -> None:
        """Show the contacts of the grasp."""
        shown = self.shown
        start, along = shown.points[self.grasp], ARROW * shown.normals[self.grasp]
        self.server.scene.add_arrows(
            "/contacts/normals",
            np.stack([start, start + along], 1),
            np.array([rgb(color) for _, color in shown.fingers]),
            shaft_radius=SHAFT,
            head_radius=HEAD,
            head_length=3 * HEAD,
        )

    def _describe(self) -> str:
        """Say what the grasp is worth, or what the fingertips feel."""
        shown, replay = self.shown, self.shown.replay
        if self.tick is not None and replay is not None:
            forces = ", ".join(
                f"{name} {force:.1f}" for (name, _), force in zip(shown.fingers, replay.forces[self.tick], strict=True)
            )
            return f"{replay.time[self.tick]:.2f} s, normal forces [N]: {escape(forces)}"
        if not shown.rows:
            return "There is no executable grasp."
        row = shown.rows[self.grasp]
        return "; ".join(f"{escape(head)} <b>{escape(cell)}</b>" for head, cell in zip(shown.heads, row, strict=True))


def split(pose: Float[np.ndarray, "4 4"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the quaternion (w, x, y, z) and the position of a rigid pose.

    >>> split(np.diag([-1.0, -1.0, 1.0, 1.0]))[0].round(6).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    x, y, z, w = Rotation.from_matrix(pose[:3, :3].astype(float)).as_quat()
    return np.array([w, x, y, z]), pose[:3, 3].astype(float)


def paragraph(markup: str) -> str:
    """Return HTML as a paragraph of the panel."""
    return f'<p style="margin: 0.4em 0.9em; font-size: 0.9em">{markup}</p>'
