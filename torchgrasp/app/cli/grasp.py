"""The command `torchgrasp grasp`, which plans grasps of an object in a cloud or a scene."""

import dataclasses
import datetime
import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import torch

from torchgrasp.app.cli import inputs
from torchgrasp.app.cli.command import (
    ForPrograms,
    StageProgress,
    answer,
    arguments,
    command_line,
    naming,
    nested,
    option,
    positional,
)
from torchgrasp.app.cli.results import (
    ENOUGH,
    describe_run,
    make_run,
    read_true_mesh,
    table_under,
    write_run,
)
from torchgrasp.app.report.run_data import RECORDING, Run, grasp_columns, grasp_rows, verdict
from torchgrasp.cloud.agreement import check_mesh, check_stand
from torchgrasp.cloud.pose import find_plausible
from torchgrasp.data.shipped import find_view
from torchgrasp.evaluation.drag_trial import lift_from_edge
from torchgrasp.evaluation.lift import close_hand
from torchgrasp.files import format_columns, format_line
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.foundation.rules import Count, Seed
from torchgrasp.geometry.frames import rigid
from torchgrasp.geometry.linalg import norm
from torchgrasp.geometry.plane import Plane, as_plane, move
from torchgrasp.geometry.signed_distance import FIELD_SPACING, field_from_surface
from torchgrasp.hand.hand import Hand
from torchgrasp.planner.clearing import order_to_clear
from torchgrasp.planner.drag_plan import DragPlan
from torchgrasp.planner.edge import EdgePlan, check_edge, plan_edge_grasps
from torchgrasp.planner.explain import Explanation, explain_empty
from torchgrasp.planner.graspable import judge_things
from torchgrasp.planner.grasps import plan_grasps
from torchgrasp.planner.objects import take_target
from torchgrasp.planner.request import Budget
from torchgrasp.planner.scene_plan import plan_scene
from torchgrasp.scene.file import scene_of
from torchgrasp.scene.image import is_scene, read_arrays
from torchgrasp.scene.masks import label_again
from torchgrasp.scene.scene import Scene
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.success.task import GraspTask, TaskName
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.planning import Grasps, PointCloud, format_success
from torchgrasp.values.specs import ContactSpec, Mode, TrialSpec

Among = Literal["auto"] | None
STAGES = ("shape", "plan", "certify", "query", "refine")
"""Stages of planning, as the planner reports them."""
DIGITS = 3  # decimals of a direction that is printed
SHOWN = 5  # grasps that are printed
OBJECT_WIDTHS = (-10, 7, -1)  # of the columns of a scene's objects


@arguments(points="cloud", normals="cloud", path="out", target="label")
class Grasp(ForPrograms):
    """Plan grasps of an object in a partial cloud or a scene. With --close, also close the hand on
    the object's mesh in simulation.

    Writes grasps.safetensors, surface.ply, report.html and the 3D page view.html into the output
    folder. If no grasp is executable, one setting at a time is changed, and the change that helps
    most is named. The cloud is checked as by `cloud check`. It is refused if the camera is below
    the table or contradicts the points, or if the unit is wrong. A cloud with two bodies, with the
    table or with another plane is refused, too. A simulator's table without noise is left out.
    Other findings are printed as advice.
    """

    cloud: Path | None = positional(
        f"{inputs.CLOUD_HELP}, a scene (.npz with depth and intrinsics; see docs/real_camera.md), "
        "or the name of a "
        "shipped object, as jug",
        default=None,
    )
    realsense: bool = option(
        False,
        "instead of CLOUD, take the depth image of a connected RealSense. It is written as scene.npz "
        'into the output folder (needs the extra "realsense")',
    )
    serial: str | None = option(None, "serial number of the RealSense, if several are connected")
    hand: str = option("allegro", inputs.HAND_HELP)
    out: Path | None = option(
        None, "folder of the results; by default out/ and the name of the object"
    )
    mesh: Path | None = option(
        None,
        "true mesh of the object [m] in the frame of the cloud, for the simulator; a shipped "
        "object has one",
    )
    close: bool = option(
        False, 'close the best grasp on the mesh, lift it and hold it (needs the extra "sim")'
    )
    seed: Seed = option(0, "random seed; the same seed gives the same grasps")
    starts: Count = option(1000, inputs.STARTS_HELP)
    time_budget: Budget | None = option(
        None, "seconds after which no batch of planning begins; by default no limit"
    )
    view: inputs.CloudOptions = nested(inputs.CloudOptions())
    friction: str = option(
        "0.8",
        "coefficient of friction between fingertips and object, or its distribution: an interval "
        "0.3:0.8, or several with | between",
    )
    mass: str = option(
        "0.25",
        "mass [kg] for which success is predicted, and with which the simulator lifts, or its "
        "distribution",
    )
    promise: float | None = option(
        None, "share of the grasps that must hold, such as 0.9; others are not returned"
    )
    fingers: str = option(
        "default",
        f'{inputs.FINGERS_HELP}; "auto" tries the options of the hand and takes the most likely '
        "to succeed",
    )
    mode: Mode = option(
        "joint",
        "contacts, pose and joints together; contacts first, then the learned model; or the paper "
        "as written",
    )
    label: int | None = option(
        None, "label of the object to grasp in a scene; by default the easiest"
    )
    point: tuple[float, float] | None = option(
        None, "column and row of a pixel on the object to grasp in a scene"
    )
    keep: str | None = option(
        None,
        "where contacts may be, in the frame of the cloud: a closed mesh, or a box as "
        '"X0 Y0 Z0 X1 Y1 Z1" [m]',
    )
    avoid: str | None = option(None, "where no contact may be: a mesh or a box, as in --keep")
    resist: tuple[TaskName, ...] = option(
        (), "loads of --mass that the contacts must resist with the hand's strength"
    )
    edge: tuple[float, ...] | None = option(
        None,
        "for low objects: X Y OX OY, a point on the edge of the table [m] and the direction away "
        "from the table. Where z is not up, give six numbers X Y Z OX OY OZ. All are in the frame "
        "of the cloud. "
        "The hand presses on the object, drags it over the edge, and grasps it there",
    )
    table_friction: float = option(
        0.3, "with --edge: coefficient of friction between object and table"
    )
    no_report: bool = option(False, "write the grasps without the pages")
    rerun: bool = option(
        False, 'also write run.rrd, a recording of plan and closing (needs the extra "rerun")'
    )

    def run(self) -> int:
        """Plan grasps, close the hand if asked, and write the results; return the exit code.

        It is 0 if a grasp passed all checks or, with --close, if the object was held; else 1.
        """
        path = self._find_input()
        out = Path("out") / inputs.object_name(path) if self.out is None else self.out
        inputs.check_folder(out)
        if self.rerun:
            from torchgrasp.app.report.recording import import_rerun  # it takes long to import

            import_rerun()
        scene = self.realsense or is_scene(path)
        self._check_choice(scene)
        self._check_edge(scene)
        _ = self._task, self._friction  # refused before any work
        hand, among = inputs.load_fingers(self.hand, self.fingers)
        if self.realsense:
            from torchgrasp.app.cli.live import shoot_scene  # it takes long to import

            path = shoot_scene(out, self.serial, self.view)
        grasp = self._grasp_scene if scene else self._grasp_cloud
        return grasp(path, out, hand, among)

    def _find_input(self) -> Path:
        """Return the path of the cloud or the scene; of a live camera only its name.

        Raises `BadArgument` for no input, or for two.
        """
        if self.serial is not None and not self.realsense:
            raise BadArgument("--serial", "no --realsense beside it", "both, or neither")
        if (self.cloud is None) != self.realsense:
            found = "none" if self.cloud is None else f"{self.cloud} beside --realsense"
            raise BadArgument("CLOUD", found, "one input: a file, a shipped object, or --realsense")
        return Path("realsense") if self.cloud is None else find_view(self.cloud, "CLOUD")

    def _check_choice(self, scene: bool) -> None:
        """Raise `BadArgument` for options of a scene with a cloud, or of a cloud with a scene."""
        if scene:
            if self.label is not None and self.point is not None:
                raise BadArgument("--point", "--label beside it", "one of the two")
            if unfit := self._of_clouds_alone():
                found = "a scene" if self.cloud is None else f"the scene {self.cloud}"
                raise BadArgument(", ".join(unfit), found, "the cloud of one object beside it")
        elif self.label is not None or self.point is not None:
            wanted = "a .npz file with depth and intrinsics"
            raise BadArgument("--label, --point", f"{self.cloud}, which is no scene", wanted)

    def _of_clouds_alone(self) -> list[str]:
        """Return the names of the given options that a scene does not take."""
        given = {
            "mesh": self.mesh is not None,
            "close": self.close,
            "mode": self.mode != "joint",
            "time-budget": self.time_budget is not None,
        }
        usual = vars(inputs.CloudOptions())
        # the pose of a live camera is part of its scene
        taken = {"table", "up", *["camera_pose"] * self.realsense}
        for name, value in vars(self.view).items():
            given[name.replace("_", "-")] = name not in taken and value != usual[name]
        return [f"--{name}" for name, is_given in given.items() if is_given]

    def _check_edge(self, scene: bool) -> None:
        """Raise `BadArgument` for --edge beside an option that the drag does not take."""
        others = {
            "a scene": scene,
            "--mode": self.mode != "joint",
            "--fingers auto": self.fingers == "auto",
            "--promise": self.promise is not None,
            "--resist": bool(self.resist),
            "--keep": self.keep is not None,
            "--avoid": self.avoid is not None,
            "--time-budget": self.time_budget is not None,
        }
        beside = [name for name, given in others.items() if given]
        if self.edge is not None and beside:
            raise BadArgument("--edge", f"{beside[0]} beside it", "one of the two")
        if self.edge is None and self.table_friction != Grasp.table_friction:
            raise BadArgument("--table-friction", "no --edge beside it", "both, or neither")

    def _grasp_cloud(self, path: Path, out: Path, hand: Hand, among: Among) -> int:
        """Plan on a point cloud and write the results; return the exit code."""
        mesh = self._true_mesh(path)
        file, view = self.view.read_standing("CLOUD", path)
        cloud = file.cloud
        table = view.plane(cloud)
        if self.edge is not None:
            table = inputs.with_edge(table, self.edge)
            check_edge(table, cloud.points, "--edge")
        plane = as_plane(table)
        make_spec = ContactSpec.paper if self.mode == "paper" else ContactSpec
        spec = make_spec(friction=self._friction, table=table)
        true_mesh, parts = (None, None) if mesh is None else read_true_mesh(mesh)
        inputs.print_notes(file.notes, view.judge(cloud, table))
        if true_mesh is not None:
            plane = check_truth(cloud, true_mesh, plane, given=view.table is not None)
        progress = StageProgress(
            *["fingers"] * (among is not None),
            *STAGES,
            *["drag"] * (self.edge is not None),
            *["closing"] * self.close,
            "report",
        )
        with progress.bar, inputs.holding("--out", out):
            progress.end("cloud", describe_seen(cloud, table, given=view.table is not None))
            grasps, explanation = self._plan(cloud, hand, spec, among, progress)
            name = inputs.object_name(path if mesh is None else mesh)
            shape = progress.values["shape"]
            edge = None
            if self.edge is not None:
                edge = self._plan_drag(cloud, hand, spec, grasps, progress)
            drag = None if edge is None else edge.drag
            if edge is not None and drag is not None:
                grasps = edge.grasps
                shape = edge.shape
                progress.values["plan"] = None  # the contacts where the object stood
                cloud = move(cloud, rigid(torch.eye(3), drag.displacement).to(cloud.points))
            given = (name, path, cloud, hand, spec, grasps, shape, self._task["task"])
            run = make_run(*given, explanation=explanation, **self._recorded(progress))
            if self.close and true_mesh is not None and len(run.executable):
                run = self._close(run, edge, true_mesh, parts, plane, progress)
            progress.end("report", self._write(out, run))
        if drag is not None:
            print(f"\ndrag first  {describe_drag(drag, run.hand)}")
        executable = print_grasps(run)
        answer(describe_run(run, out))
        good = run.closure is not None and run.closure.held if self.close else executable
        return 0 if good else 1

    def _plan(
        self,
        source: PointCloud | Scene,
        hand: Hand,
        spec: ContactSpec,
        among: Among,
        progress: StageProgress,
    ) -> tuple[Grasps, Explanation | None]:
        """Return the grasps of a cloud or of a scene's target. If none is executable, return also
        what would help, but not with --edge.
        """
        given = (source, hand, spec, self.starts, self.seed)
        options: dict[str, Any] = {"fingers": among, "mode": self.mode, "observer": progress.end}
        options |= self._task
        grasps = plan_grasps(*given, **options, time_budget=self.time_budget)
        if self.edge is not None or (grasps.status == Status.OK).any():
            return grasps, None
        return grasps, explain_empty(*given, **options)

    def _plan_drag(
        self,
        cloud: PointCloud,
        hand: Hand,
        spec: ContactSpec,
        stands: Grasps,
        progress: StageProgress,
    ) -> EdgePlan | None:
        """Return a drag to the table's edge with grasps there. Return None if there is none, or if
        the grasps where the object `stands` are as likely to hold.
        """
        plan = plan_edge_grasps(
            cloud,
            hand,
            spec,
            self.starts,
            self.seed,
            task=GraspTask(self._mass),
            table_friction=self.table_friction,
        )
        if plan.drag is None:
            progress.end("drag", f"none: {plan.reason}")
            return None
        sure = 0.0 if math.isnan(plan.success) else plan.success
        found = f"{describe_best(stands)} where it stands, {describe_best(plan.grasps)} at the edge"
        known = "success unknown" if math.isnan(plan.success) else f"{sure:.0%}"
        found += f", {known} with the drag"
        better = rank_best(plan.grasps) >= 0 and sure > rank_best(stands)
        progress.end("drag", f"{found}: {'dragged to the edge' if better else 'it stays'}")
        return plan if better else None

    def _close(
        self,
        run: Run,
        edge: EdgePlan | None,
        mesh: "trimesh.Trimesh",
        parts: "list[trimesh.Trimesh] | None",
        table: Plane | None,
        progress: StageProgress,
    ) -> Run:
        """Return the run with the closing of its best grasp on the true mesh. The closing follows
        the drag if there is one.
        """
        friction = None if self.edge is None else self.table_friction
        trial = TrialSpec(friction=self._friction, mass=self._mass, table_friction=friction)
        options = {"parts": parts, "table": table}
        if edge is None:
            surface = run.surface
            felt = field_from_surface(surface.vertices, surface.faces, FIELD_SPACING)
            closure = close_hand(
                run.executable[0], run.hand, mesh, trial, seed=self.seed, surface=felt, **options
            )
        else:
            lift = lift_from_edge(edge, run.hand, mesh, trial, self.seed, **options)
            if not lift.tries:
                assert lift.drag is not None
                progress.end("closing", f"the drag failed: {lift.drag.status.sentence}")
                return dataclasses.replace(run, stages=tuple(progress.stages))
            if lift.drag is not None:
                mesh = mesh.copy().apply_transform(lift.drag.motion.numpy())
            closure = lift.tries[-1].result
        progress.end(
            "closing", f"{closure.time[-1]:.1f} s simulated, {closure.status.name.lower()}"
        )
        stages = tuple(progress.stages)
        return dataclasses.replace(run, stages=stages, mesh=mesh, closure=closure)

    def _recorded(self, progress: StageProgress) -> dict[str, Any]:
        """Return what `Run` holds of the course of the command."""
        now = datetime.datetime.now(datetime.timezone.utc)
        return {
            "stages": tuple(progress.stages),
            "plan": progress.values.get("plan"),
            "command": command_line(),
            "date": now.strftime("%Y-%m-%d %H:%M UTC"),
        }

    @functools.cached_property
    def _friction(self) -> float | Distribution:
        """The friction of --friction."""
        return inputs.read_distribution("--friction", self.friction)

    @functools.cached_property
    def _mass(self) -> float | Distribution:
        """The mass [kg] of --mass."""
        return inputs.read_distribution("--mass", self.mass)

    @functools.cached_property
    def _task(self) -> dict[str, Any]:
        """The options of the planner that say what the grasps must do, and where."""
        return {
            "task": GraspTask(self._mass),
            "promise": self.promise,
            "resist": self.resist or None,
            "keep": inputs.read_region("--keep", self.keep),
            "avoid": inputs.read_region("--avoid", self.avoid),
        }

    def _true_mesh(self, path: Path) -> Path | None:
        """Return the path of the true mesh, or None if there is none; raise `BadArgument` if
        --close has no mesh.
        """
        mesh = self.mesh
        shipped = path != self.cloud  # the cloud is given by name
        if shipped and self.close and mesh is None:
            mesh = path.with_name("mesh.ply")
        if self.close:
            if mesh is None:
                raise BadArgument("--close", "no --mesh", "--close together with --mesh")
            inputs.import_simulator()
        return mesh

    def _grasp_scene(self, path: Path, out: Path, hand: Hand, among: Among) -> int:
        """Plan for the chosen object of a scene, or the easiest object, and write the results;
        return the exit code.
        """
        spec = ContactSpec(friction=self._friction)
        scene = self._read_scene(path)
        progress = StageProgress("scene", *["fingers"] * (among is not None), *STAGES, "report")
        with progress.bar, inputs.holding("--out", out):
            labels = ", ".join(map(str, scene.things))
            several = "s" * (len(scene.things) != 1)
            progress.end("scene", f"{len(scene.things)} object{several}, label{several} {labels}")
            inputs.print_notes(scene.notes)
            advice = list(scene.advice)
            if scene.target is not None:
                judged = judge_things(scene, hand, spec)[scene.target]
                advice += [judged.sentence] if judged is not Status.OK else []
            for sentence in advice:
                print(f"advice  {sentence}")
            explanation = None
            if scene.target is not None:
                grasps, explanation = self._plan(scene, hand, spec, among, progress)
                shape = progress.values["shape"]
            else:
                best = self._find_easiest(scene, hand, spec, among, progress)
                if best is None:
                    answer({"executable": 0, "hand": hand.name, "best": None})
                    return 1
                scene, grasps, shape = best
                # some advice is on the target alone
                for sentence in scene.advice:
                    if sentence not in advice:
                        print(f"advice  {sentence}")
            spec = dataclasses.replace(spec, table=scene.table)
            cloud = take_target(scene, self.seed)
            name = f"object {scene.target}"
            given = (name, path, cloud, hand, spec, grasps, shape, self._task["task"])
            known = {"explanation": explanation, "scene": scene}
            run = make_run(*given, **known, **self._recorded(progress))
            progress.end("report", self._write(out, run))
            clear = ()
            if explanation is not None:
                options = {"fingers": among, "mode": self.mode, **self._task}
                plan = functools.partial(
                    plan_grasps, hand=hand, spec=spec, seed=self.seed, **options
                )
                clear = order_to_clear(scene, plan, self.starts)
                progress.end("clear", name_in_order(clear) or "no object that is in the way")
        executable = print_grasps(run)
        if clear:
            first = name_in_order(clear)
            print(f"take away first  {first}; object {scene.target} then has a grasp")
        of_scene = {"label": scene.target, "clear": list(clear), "doubts": list(scene.doubts)}
        answer(describe_run(run, out) | of_scene)
        return 0 if executable else 1

    def _read_scene(self, path: Path) -> Scene:
        """Return the scene of a file with the table of --table or --up, and the chosen target."""
        choice = self.point if self.label is None else self.label
        arrays_of_scene = ("depth", "intrinsics", "mask", "labels", "camera_pose", "table")
        names = {name: f"CLOUD: {name}" for name in arrays_of_scene}
        names |= {"path": "CLOUD", "points": "CLOUD", "target": "--label", "point": "--point"}
        options = {"table": "--table", "up": "--up"}
        with naming(**names):
            arrays = read_arrays(path)
        found = "table" in arrays
        with naming(**names if found else names | options):
            # a table that is given is not searched first
            scene = scene_of(arrays, self.view.given_table, self.view.vertical)
        with naming(**options, target="--label", point="--point"):
            # the shot of a live camera is on the table of the options
            if found and not self.realsense:
                scene = self._with_table(scene, choice is not None)
            return scene if choice is None else scene.select(choice)

    def _with_table(self, scene: Scene, chosen: bool) -> Scene:
        """Return the scene with the table of --table or --up; raise `BadArgument` if the target is
        then lost.
        """
        if (self.view.table is None and self.view.up is None) or scene.table is None:
            return scene
        image = scene.image
        name = "--up" if self.view.table is None else "--table"
        table, up = self.view.given_table, self.view.vertical
        supports = find_plausible(scene.points, image.obj_from_camera, table, up, known_unit=True)
        labels = label_again(
            image, scene.table, supports[0], scene.pixel_labels, scene.given, scene.target or 0
        )
        labels = labels[tuple(scene.pixels.T)]
        planes = tuple(support.plane for support in supports)
        target = None if chosen else scene.target
        again = dataclasses.replace(
            scene, labels=labels, table=planes[0], others=planes[1:], target=target
        )
        if not again.things or target not in (None, *again.things):
            lost = f"object {target}, the target," if again.things else "every object"
            wanted = "one that keeps the target, or another target by --label or --point"
            raise BadArgument(
                name, f"a table ({planes[0].describe()}) with which {lost} is lost", wanted
            )
        old = set(scene.things)
        new = set(again.things)
        given = set(scene.given)
        said = {
            "kept, but for pixels of the table": new & given,
            "found again": new - given,
            "lost": old - new,
        }
        inputs.print_notes(
            tuple(f"objects {how}: {str(sorted(some))[1:-1]}" for how, some in said.items() if some)
        )
        return again

    def _write(self, out: Path, run: Run) -> str:
        """Write grasps and estimated surface of a run, its HTML pages unless --no-report, and its
        recording.
        """
        paths = write_run(out, run, pages=not self.no_report)
        if self.rerun:
            from torchgrasp.app.report.recording import write_recording

            paths.append(write_recording(out / RECORDING, run))
        return ", ".join(map(str, paths))

    def _find_easiest(
        self, scene: Scene, hand: Hand, spec: ContactSpec, among: Among, progress: StageProgress
    ) -> tuple[Scene, Grasps, ShapeGP] | None:
        """Plan for the objects of a scene until one is easy. Return the scene with it as target,
        grasps and shape. Return None if no object has a grasp.
        """
        options = {"fingers": among, "enough": ENOUGH, **self._task}
        plan = plan_scene(scene, hand, spec, self.starts, self.seed, **options)
        print(format_line(("object", "success", "result"), OBJECT_WIDTHS))
        for thing in plan.things:
            count = 0 if thing.grasps is None else len(thing.grasps)
            text = thing.reason or f"{count} executable grasps"
            # what was not planned has no prediction
            likely = "-" if thing.grasps is None else format_success(thing.success)
            cells = f"object {thing.label}", likely, text
            print(format_line(cells, OBJECT_WIDTHS), flush=True)
        graspable = sum(thing.grasps is not None for thing in plan.things)
        progress.end("objects", f"{graspable} with a grasp")
        if plan.best is None or plan.best.grasps is None or plan.best.shape is None:
            print(f"The {hand.name} hand has no executable grasp of any object in the scene.")
            print("With --label or --point, changes that would help are tried for one of them.")
            return None
        return scene.select(plan.best.label), plan.best.grasps, plan.best.shape


def check_truth(
    cloud: PointCloud, mesh: "trimesh.Trimesh", table: Plane | None, given: bool
) -> Plane | None:
    """Return the table on which the true mesh [m] stands; None without a `table`.

    All are in the frame of the cloud. A table that the user has `given` is returned unchanged.
    Another is a guess, and is moved along its normal to the mesh's lowest point. Raises
    `BadArgument` if over 20 % of the cloud's points are off the mesh. A point is off beyond 10 mm
    plus twice the camera's noise. Raises it also if the mesh ends over 15 mm from a given table.
    """
    check_mesh(cloud, mesh, "--mesh")
    if not given:
        return table_under(mesh, table)
    if table is not None:
        check_stand(mesh, table, "--mesh")
    return table


def describe_seen(cloud: PointCloud, table: Plane | float | None, given: bool) -> str:
    """Return a text on a cloud: number of points, whether the camera is known, where the table is.

    `table` is a plane, a height z [m], or None for no table. Unless the user has `given` it, the
    text says that it is at the lowest point of the cloud.
    """
    camera = "camera known" if cloud.viewpoint is not None else "camera estimated"
    place = "no table"
    if table is not None:
        place = f"{inputs.describe_table(table)}{'' if given else ' (lowest point)'}"
    return f"{len(cloud)} points, {camera}, {place}"


def print_grasps(run: Run) -> bool:
    """Print the best executable grasps of a plan, which passed all checks, and the result in a
    sentence.

    Printed are also what lowers the predicted success, and from where a second view would help.
    Return whether any grasp is executable. `run` is the record of the plan.
    """
    if len(run.executable):
        print(
            f"\n{format_columns([grasp_columns(run.grasps), *grasp_rows(run.executable, SHOWN)])}\n"
        )
    for sentence in run.costs:
        print(f"lowers success  {sentence}")
    if run.look is not None:
        print(f"look next  from {run.look.sentence}")
    print(verdict(run))
    return len(run.executable) > 0


def name_in_order(labels: Sequence[int]) -> str:
    """Return a text that names objects of a scene by their labels, as "object 3, then object 1".

    The labels are in the order in which the objects are taken away.
    """
    return ", then ".join(f"object {label}" for label in labels)


def rank_best(grasps: Grasps) -> float:
    """Return the predicted success, in [0, 1], of the best grasp that passed all checks.

    It is 0 if the success is unknown, and -1 without such a grasp.
    """
    best = grasps.executable[:1]
    return max(0.0, *best.success.nan_to_num().tolist()) if len(best) else -1.0


def describe_best(grasps: Grasps) -> str:
    """Return a text with the predicted success of the best grasp that passed all checks.

    It is "no grasp" if none did.
    """
    best = grasps.executable[:1]
    return f"success {format_success(best)}" if len(best) else "no grasp"


def describe_drag(drag: DragPlan, hand: Hand) -> str:
    """Return a sentence on a drag of the object over the table to its edge.

    It names the fingers that press, their force [N], and the length [mm] and direction of the drag.
    The direction is a unit vector in the frame of the cloud.
    """
    pressing = [
        name
        for name, pressed in zip(hand.tips.names, drag.presses.tolist(), strict=True)
        if pressed
    ]
    length = float(norm(drag.displacement))
    along = ", ".join(f"{0.0 + round(x, DIGITS):g}" for x in (drag.displacement / length).tolist())
    fingers = " and ".join(pressing)
    return (
        f"{fingers} press on the object from above with {drag.force:.1f} N, "
        f"and drag it {1e3 * length:.0f} mm along ({along})"
    )
