"""The tools that `torchgrasp mcp` offers to agents: arguments with units and bounds, and the work.

A tool is a value whose fields are its arguments; `run` does the work. Tools share nothing but
files, all of them below one folder.
"""

import dataclasses
import importlib.util
import json
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch

from torchgrasp import __version__
from torchgrasp.app.cli.agent_answers import (
    AdviceRow,
    Answer,
    ChangeRow,
    CloseAnswer,
    CloudAnswer,
    ExplainAnswer,
    GraspRow,
    HandAnswer,
    HealthAnswer,
    LookRow,
    LossRow,
    PictureAnswer,
    PlanAnswer,
    ThingRow,
    Vector,
)
from torchgrasp.app.cli.agent_files import Workplace
from torchgrasp.app.cli.clouds import CloudCheck
from torchgrasp.app.cli.command import naming, option, required
from torchgrasp.app.cli.depth_images import CloudScene, DepthUnit
from torchgrasp.app.cli.doctor import SIMULATORS
from torchgrasp.app.cli.grasp import Grasp
from torchgrasp.app.cli.hands import TRIAL, describe, find_warnings, list_faults, list_unusual
from torchgrasp.app.cli.inputs import (
    CLOUD_HELP,
    HAND_HELP,
    SEED_HELP,
    STARTS_HELP,
    CloudOptions,
    check_folder,
    holding,
    import_simulator,
    load_fingers,
    object_name,
    read_distribution,
    read_table,
)
from torchgrasp.app.cli.results import (
    ENOUGH,
    GRASPS,
    REPORT,
    SURFACE,
    describe_look,
    make_run,
    read_true_mesh,
    table_under,
    write_run,
)
from torchgrasp.app.report.run_data import VIEW, verdict
from torchgrasp.app.report.stills import draw_grasp, facing, rotated
from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.cloud.read import save_cloud
from torchgrasp.contacts.region import Region
from torchgrasp.data.shards import load_grasps
from torchgrasp.data.shipped import list_objects
from torchgrasp.evaluation.lift import close_hand
from torchgrasp.export import format_grasps
from torchgrasp.files import write_file
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, GraspError
from torchgrasp.foundation.rules import Fraction, Range, Seed
from torchgrasp.geometry.frames import inverse, real
from torchgrasp.geometry.mesh import read_mesh
from torchgrasp.geometry.plane import Plane, as_plane, move, upright_frame, upright_table
from torchgrasp.geometry.signed_distance import FIELD_SPACING, field_from_surface
from torchgrasp.hand.abilities import hand_abilities, random_joints
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import hand_of, list_hands
from torchgrasp.planner.explain import Explanation, explain_empty
from torchgrasp.planner.grasps import plan_grasps
from torchgrasp.planner.objects import take_target
from torchgrasp.planner.request import finger_sets
from torchgrasp.planner.scene_plan import plan_scene
from torchgrasp.scene.file import read_scene, save_scene
from torchgrasp.scene.image import is_scene
from torchgrasp.scene.scene import Scene
from torchgrasp.shape.second_view import NextView
from torchgrasp.shape.surface import Surface
from torchgrasp.success.task import GraspTask
from torchgrasp.testing import check_hand
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.planning import Grasps, PointCloud, format_success
from torchgrasp.values.specs import FRICTIONS, MASSES, ContactSpec, Simulator, TrialSpec

JSON = "grasps.json"  # file beside the others that planning writes into its folder


@dataclasses.dataclass(frozen=True)
class ToolBounds:
    """Bounds of what a call may ask for, so that no call occupies the machine for long."""

    # greatest number of initial guesses: they take about a minute on a slow core
    starts: int = 2000
    # number of initial guesses by default: enough for most objects, in some ten seconds
    few: int = 300
    # greatest number of grasps of an answer: each is about 2 kB for the agent to read
    listed: int = 20
    some: int = 3  # number of grasps of an answer by default
    hold: float = 10.0  # longest time for which the raised object is held [s]
    points: int = 20_000  # greatest number of points of a rendered view: a shape is fitted to fewer


BOUNDS = ToolBounds()


def _help_of(command: Any) -> dict[str, str]:
    """Return what the command line says of the arguments of a command, by name."""
    return {field.name: field.metadata.get("help", "") for field in dataclasses.fields(command)}


VIEW_HELP = _help_of(CloudOptions)
PLAN_HELP = _help_of(Grasp)
DEPTH_HELP = _help_of(CloudScene)
Box = tuple[float, float, float, float, float, float]
Starts = Annotated[int, Range(1, BOUNDS.starts)]
Shown = Annotated[int, Range(1, BOUNDS.listed)]
Rank = Annotated[int, Range(0, 10_000)]
Friction = Annotated[float, FRICTIONS] | str
Mass = Annotated[float, MASSES] | str
OR_TEXT = 'a number, or a text as "0.3:0.8" for an interval, "0.2|0.8" for one or the other'
GRASPS_HELP = f"file {GRASPS} that a plan wrote, as its answer names it"
RANK_HELP = "rank of the executable grasp in the plan's answer; 0 is the best"
MESH_HELP = "closed mesh [m] (.ply, .obj, .stl, .off), or the name of a shipped object, as jug"


def law_of(name: str, given: float | str) -> float | Distribution:
    """Return the value of a tool's argument, such as friction, as a number or a distribution.

    A number is returned as it is. A text is read, such as "0.3:0.8" for an interval, or "0.2|0.8"
    for two values of equal probability. Raises `BadArgument`, which calls the argument `name`, for
    another text.
    """
    return read_distribution(name, given) if isinstance(given, str) else given


def region_of(name: str, box: Box | None) -> Region | None:
    """Return the region of space inside a box; None for None.

    `box` holds the box's least x, y and z, then its greatest [m], in the frame of the cloud. Raises
    `BadArgument`, which calls the argument `name`, for another order.
    """
    if box is None:
        return None
    low, high = real(box).split(3)
    with naming(low=name):
        return Region.box(low, high)


class Tool:
    """Base of all tools that agents may call; the fields of a tool are its arguments."""

    def run(self, place: Workplace) -> Answer:
        """Run the tool, and return its answer. It reads and writes files below the folder `place`
        alone.
        """
        raise NotImplementedError


@dataclasses.dataclass(frozen=True, kw_only=True)
class _SeenTool(Tool):
    """Arguments of a tool that reads a cloud."""

    cloud: str = required(f"{CLOUD_HELP}, or the name of a shipped object, as jug")
    unit: Literal["m", "cm", "mm"] = option("m", VIEW_HELP["unit"])
    viewpoint: Vector | None = option(None, VIEW_HELP["viewpoint"])
    up: Vector | None = option(None, VIEW_HELP["up"])
    camera_pose: str | None = option(None, VIEW_HELP["camera_pose"])
    table: tuple[float, ...] | None = option(None, VIEW_HELP["table"])
    no_table: bool = option(False, VIEW_HELP["no_table"])

    def options(self, place: Workplace) -> CloudOptions:
        """Return the options of the command line for the same cloud."""
        pose = self.camera_pose
        given: Any = {
            "unit": self.unit,
            "viewpoint": self.viewpoint,
            "up": self.up,
            "camera_pose": None if pose is None else place.file("camera_pose", pose),
            "table": self.table,
            "no_table": self.no_table,
        }
        return CloudOptions(**given)

    def see(self, place: Workplace, path: Path) -> "_Seen":
        """Return the cloud of a file with its table; raise `BadArgument` for an unusable cloud."""
        view = self.options(place)
        file, view = view.read_standing("cloud", path)
        table = view.plane(file.cloud)
        advice = view.judge(file.cloud, table)
        return _Seen(path, file.cloud, table, (*file.notes, *map(str, advice)))


@dataclasses.dataclass(frozen=True)
class _Seen:
    """What a plan is made for: a cloud or a scene, its table, and what was noticed."""

    path: Path
    source: PointCloud | Scene
    table: Plane | float | None
    notes: tuple[str, ...] = ()

    @classmethod
    def in_scene(cls, path: Path, scene: Scene) -> "_Seen":
        """Return what is seen in the scene of a file."""
        return cls(path, scene, scene.table, (*scene.notes, *scene.advice))

    @property
    def name(self) -> str:
        """The name of the object that is grasped."""
        if isinstance(self.source, Scene):
            return f"object {self.source.target}"
        return object_name(self.path)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _HandTool(Tool):
    """Arguments of a tool that plans with a hand."""

    hand: str = option("allegro", HAND_HELP)
    fingers: str = option("default", PLAN_HELP["fingers"])
    starts: Starts = option(BOUNDS.few, STARTS_HELP)
    seed: Seed = option(0, SEED_HELP)
    friction: Friction = option(
        0.8, f"coefficient of friction between fingertips and object: {OR_TEXT}"
    )
    mass: Mass = option(0.25, f"mass of the object [kg], for which success is predicted: {OR_TEXT}")
    promise: Fraction | None = option(None, PLAN_HELP["promise"])
    keep: Box | None = option(
        None, "box x0 y0 z0 x1 y1 z1 [m] in the frame of the cloud, where contacts may be"
    )
    avoid: Box | None = option(None, "box, as of keep, where no contact may be")

    def load(self, place: Workplace) -> tuple[Hand, Literal["auto"] | None]:
        """Return the hand, and "auto" if all its sets of fingers are tried."""
        return load_fingers(place.hand("hand", self.hand), self.fingers)

    def task(self) -> dict[str, Any]:
        """Return the options of the planner that say what the grasps must do, and where."""
        return {
            "task": self.grasp_task,
            "promise": self.promise,
            "keep": region_of("keep", self.keep),
            "avoid": region_of("avoid", self.avoid),
        }

    @property
    def law(self) -> float | Distribution:
        """The friction, or its distribution."""
        return law_of("friction", self.friction)

    @property
    def grasp_task(self) -> GraspTask:
        """The task for which success is predicted."""
        return GraspTask(law_of("mass", self.mass))


@dataclasses.dataclass(frozen=True, kw_only=True)
class _PlanTool(_HandTool):
    """Arguments of a tool that plans grasps and writes them."""

    most: Shown = option(BOUNDS.some, "most grasps in the answer; the file has all")
    pages: bool = option(False, "also write pages for a person: a report, and the grasp in 3D")
    out: str | None = option(
        None, "folder to write below the server's folder; by default out/ and the object's name"
    )

    def plan(self, place: Workplace, seen: _Seen, out: Path) -> PlanAnswer:
        """Plan grasps of what is seen, write them into a folder, and return the answer."""
        hand, among = self.load(place)
        spec = ContactSpec(friction=self.law, table=seen.table)
        told = dict[str, Any]()
        grasps = plan_grasps(
            seen.source,
            hand,
            spec,
            self.starts,
            self.seed,
            fingers=among,
            **self.task(),
            observer=lambda stage, _, value: told.update({stage: value}),
        )
        return self.write(place, seen, out, hand, grasps, told)

    def write(
        self,
        place: Workplace,
        seen: _Seen,
        out: Path,
        hand: Hand,
        grasps: Grasps,
        told: dict[str, Any],
    ) -> PlanAnswer:
        """Write grasps with the surface and pages of their plan; return the answer.

        `told` holds the estimated "shape" and, if it is known, the "plan" of contacts.
        """
        scene = seen.source if isinstance(seen.source, Scene) else None
        cloud = take_target(scene, self.seed) if scene is not None else seen.source
        assert isinstance(cloud, PointCloud)
        spec = ContactSpec(friction=self.law, table=seen.table)
        given = (seen.name, seen.path, cloud, hand, spec, grasps, told["shape"], self.grasp_task)
        run = make_run(*given, plan=told.get("plan"), scene=scene)
        write_run(out, run, self.pages)
        files = dict[str, Any](grasps_file=place.tell(out / GRASPS))
        good = run.executable
        rows = list[GraspRow]()
        if len(good):
            content = format_grasps(run.hand, good[: self.most])
            rows = [_row(row, good) for row in json.loads(content)["grasps"]]
            write_file(out / JSON, content)
            files["json_file"] = place.tell(out / JSON)
            files["surface_file"] = place.tell(out / SURFACE)
        if self.pages:
            files["pages"] = (place.tell(out / REPORT), place.tell(out / VIEW))
        return PlanAnswer(
            verdict=verdict(run),
            hand=run.hand.name,
            fingers=run.hand.finger_names,
            executable=len(good),
            planned=len(grasps),
            grasps=tuple(rows),
            lowers_success=run.costs,
            look_next=None if run.look is None else _look_row(run.look),
            notes=seen.notes,
            **files,
        )


def _look_row(view: NextView) -> LookRow:
    """Return a camera for a second view as a row of an answer."""
    told = describe_look(view)
    told["obj_from_camera_m"] = tuple(tuple(row) for row in told["obj_from_camera_m"])
    return LookRow(**told)


def _row(row: dict[str, Any], grasps: Grasps) -> GraspRow:
    """Return one of the grasps, described by the JSON of `format_grasps`, as a row of an answer."""
    bounds = grasps.interval
    return GraspRow(
        rank=row["rank"],
        success=row["success"],
        interval=None if bounds is None else tuple(bounds[row["rank"]].tolist()),
        position=tuple(row["pose"]["position"]),
        quaternion_wxyz=tuple(row["pose"]["quaternion_wxyz"]),
        approach=tuple(row["approach"]["direction"]),
        rise=tuple(row["rise"]),
        **row["joints"],
    )


@checked
@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanFromCloud(_PlanTool, _SeenTool):
    """Plan grasps of the object in a point cloud, and write them into a folder.

    Answers the best grasps: pose of the hand, joints by name, and the predicted success. The cloud
    shows one object without its table, from one or more sides.
    """

    def run(self, place: Workplace) -> PlanAnswer:
        """Plan on the cloud, and return the answer. All files are in the folder `place`."""
        path = place.cloud("cloud", self.cloud)
        out = place.out(self.out, path)
        seen = self.see(place, path)
        check_folder(out)
        with holding("out", out):
            answer = self.plan(place, seen, out)
        return dataclasses.replace(answer, seen_file=self.cloud)


@checked
@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanFromDepth(_PlanTool):
    """Plan grasps of an object in a depth image, and write them into a folder.

    The table and the objects are found in the image. A mask or a pixel chooses the object;
    otherwise it is the easiest one. The answer is in the frame of camera_pose. Without it, the
    frame is the camera's (x right, y down, z forward).
    """

    depth: str = required(
        "depth image along the optical axis (.png of 16 bit, .tiff, .exr, .npy, .npz). Integers "
        "are millimetres, floats metres; 0 and NaN are not measured"
    )
    intrinsics: tuple[float, ...] | str = required(
        "fx fy cx cy [pixels] at the image's own resolution. Or a file of ROS, Open3D, RealSense, "
        "Zivid or BOP (.json, .yaml)"
    )
    depth_unit: DepthUnit | None = option(None, DEPTH_HELP["depth_unit"])
    mask: str | None = option(
        None, "mask of the object (.png, .tiff, .npy), of the depth's size and not 0 there"
    )
    point: tuple[float, float] | None = option(
        None, "column and row of a pixel on the object [pixels]"
    )
    camera_pose: str | None = option(None, DEPTH_HELP["camera_pose"])
    up: Vector | None = option(None, DEPTH_HELP["up"])
    table: tuple[float, ...] | None = option(None, DEPTH_HELP["table"])

    def run(self, place: Workplace) -> PlanAnswer:
        """Find the objects, plan on the chosen or the easiest one, and return the answer.

        All files are in the folder `place`.
        """
        path = place.file("depth", self.depth)
        out = place.out(self.out, path)
        scene = self.see(place, path)
        check_folder(out)
        seen = _Seen.in_scene(path, scene)
        file = out / "scene.npz"
        with holding("out", out):
            if scene.target is not None:
                save_scene(scene, file)
                answer = self.plan(place, seen, out)
            else:
                answer = self.choose(place, seen, scene, out, file)
        return dataclasses.replace(answer, seen_file=place.tell(file))

    def see(self, place: Workplace, path: Path) -> Scene:
        """Return the scene that the depth image at `path` shows: its table and its objects.

        The folder `place` has the other files that the arguments name. Raises `BadArgument` for an
        unusable image, and `NoSupport` without a plane on which objects stand.
        """
        known = self.intrinsics
        if isinstance(known, str):
            camera = (str(place.file("intrinsics", known)),)
        else:
            camera = tuple(map(repr, known))
        mask = None if self.mask is None else place.file("mask", self.mask)
        moved = self.camera_pose
        given: Any = {
            "depth": path,
            "intrinsics": camera,
            "depth_unit": self.depth_unit,
            "mask": mask,
            "camera_pose": None if moved is None else place.file("camera_pose", moved),
            "up": self.up,
            "out": path,  # the command is not run, and writes nothing
        }
        command = CloudScene(**given)
        depth, matrix, labels, pose = command.images()
        with naming(frame_from_camera="camera_pose", obj_from_camera="camera_pose"):
            return Scene.from_depth(
                depth,
                matrix,
                pose,
                mask=labels,
                point=self.point,
                table=None if self.table is None else read_table(self.table),
                up=command.vertical,
                depth_unit=self.depth_unit,
            )

    def choose(
        self, place: Workplace, seen: _Seen, scene: Scene, out: Path, file: Path
    ) -> PlanAnswer:
        """Plan for the objects of a scene in turn, and return the answer for the one of highest
        predicted success.

        After an object with a predicted success of 0.9 (`ENOUGH`) or more, no further one is tried.
        `seen` is the `scene` with notes for the user. The scene is written to `file`, and the
        results to the folder `out`. All files are below the folder `place`.
        """
        hand, among = self.load(place)
        spec = ContactSpec(friction=self.law)
        options = {"fingers": among, "enough": ENOUGH, **self.task()}
        plan = plan_scene(scene, hand, spec, self.starts, self.seed, **options)
        rows = tuple(
            ThingRow(label=thing.label, success=thing.success, reason=thing.reason)
            for thing in plan.things
        )
        best = plan.best
        if best is None or best.grasps is None:
            save_scene(scene, file)
            said = f"The {hand.name} hand has no executable grasp of any object in the scene."
            return PlanAnswer(
                verdict=said,
                hand=hand.name,
                fingers=hand.finger_names,
                executable=0,
                planned=0,
                grasps=(),
                objects=rows,
                notes=seen.notes,
            )
        chosen = scene.select(best.label)
        save_scene(chosen, file)
        # some advice is on the target alone
        notes = dict.fromkeys((*seen.notes, *chosen.advice))
        seen = dataclasses.replace(seen, source=chosen, notes=tuple(notes))
        told = {"shape": best.shape}
        answer = self.write(place, seen, out, hand, best.grasps, told)
        return dataclasses.replace(answer, objects=rows)


@checked
@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanFromMesh(_PlanTool):
    """Plan grasps of an object whose mesh is known: a simulated depth camera sees it from one side.

    The object stands with its lowest point on the table, z up. The answer is in the mesh's frame.
    """

    mesh: str = required(MESH_HELP)
    azimuth: float = option(30.0, "direction of the camera from the mesh, from x to y [degrees]")
    elevation: Annotated[float, Range(-89.0, 89.0)] = option(
        30.0, "elevation of the camera above the horizontal [degrees]"
    )
    distance: Annotated[float, Range(0.1, 5.0)] = option(
        0.5, "distance of the camera from the centre of the mesh [m]"
    )
    points: Annotated[int, Range(100, BOUNDS.points)] = option(1000, "number of points")
    noise: bool = option(True, "the noise of an active stereo camera; else the camera is exact")
    no_table: bool = option(False, VIEW_HELP["no_table"])

    def run(self, place: Workplace) -> PlanAnswer:
        """Render a view of the mesh, plan on it, and return the answer. All files are in the folder
        `place`.
        """
        path = place.mesh("mesh", self.mesh)
        out = place.out(self.out, path)
        solid = read_mesh(path)
        pose = look_at(self.azimuth, self.elevation, self.distance, solid)
        cloud = partial_view(solid, pose, self.points, self.noise, self.seed)
        table = None if self.no_table else as_plane(float(solid.bounds[0, 2]))
        check_folder(out)
        file = out / "view.npz"
        with holding("out", out):
            save_cloud(cloud, file, table)
            answer = self.plan(place, _Seen(path, cloud, table), out)
        return dataclasses.replace(answer, seen_file=place.tell(file))


@checked
@dataclasses.dataclass(frozen=True, kw_only=True)
class ExplainEmpty(_HandTool, _SeenTool):
    """Say why a plan has no executable grasp, and which single change would help most.

    Takes the arguments of the plan; cloud may be the scene that planning on a depth image wrote.
    Each change is tried by planning with it, which takes some seconds each.
    """

    label: int | None = option(
        None, "label of the object in a scene; by default the one that was planned for"
    )

    def run(self, place: Workplace) -> ExplainAnswer:
        """Find why no grasp passes all checks and which change helps, and return the answer.

        All files are in the folder `place`. Raises `BadArgument` for a label beside a cloud.
        """
        path = place.cloud("cloud", self.cloud)
        if is_scene(path):
            scene = read_scene(path)
            scene = scene if self.label is None else scene.select(self.label)
            seen = _Seen.in_scene(path, scene)
        elif self.label is not None:
            raise BadArgument("label", "a label beside a cloud", "a scene, which has labels")
        else:
            seen = self.see(place, path)
        hand, among = self.load(place)
        spec = ContactSpec(friction=self.law, table=seen.table)
        given = (seen.source, hand, spec, self.starts, self.seed)
        found = explain_empty(*given, fingers=among, **self.task())
        return _explained(found, seen.notes)


def _explained(found: Explanation, notes: tuple[str, ...]) -> ExplainAnswer:
    """Return an explanation as an answer."""
    stages = [
        LossRow(
            stage=one.stage,
            given=one.given,
            kept=one.kept,
            things=one.things,
            reasons={status.sentence: count for status, count in one.lost.items()},
        )
        for one in found.funnel.stages
    ]
    changes = [
        ChangeRow(
            change=one.words, choice=one.choice, executable=one.executable, expected=one.expected
        )
        for one in found.trials
    ]
    return ExplainAnswer(
        advice=found.advice,
        starts=found.starts,
        stages=tuple(stages),
        changes=tuple(changes),
        notes=notes,
    )


@checked
@dataclasses.dataclass(frozen=True, kw_only=True)
class CheckCloud(_SeenTool):
    """Report on the quality of a point cloud, with advice for a better one.

    Tells whether grasps are planned on it; if not, what mends it.
    """

    def run(self, place: Workplace) -> CloudAnswer:
        """Measure the cloud, and return the answer. All files are in the folder `place`."""
        path = place.cloud("cloud", self.cloud)
        given: Any = {"file": path, "view": self.options(place)}
        notes, report, refusals = CloudCheck(**given).judge()
        advice = [AdviceRow(**vars(one)) for one in (*refusals, *report.advice)]
        return CloudAnswer(
            usable=not any(one.refused for one in advice),
            advice=tuple(advice),
            points=report.points,
            size=report.size,
            spacing=report.spacing,
            noise=report.noise,
            outliers=report.outliers,
            camera_given=report.viewpoint_given,
            notes=notes,
        )


@checked
@dataclasses.dataclass(frozen=True, kw_only=True)
class CheckHand(Tool):
    """List every fault of a hand's files or, if there is none, describe the hand.

    A hand is shipped, or a folder with hand.toml and a URDF below the server's folder.
    """

    hand: str = required(HAND_HELP)
    fingers: str = option("default", PLAN_HELP["fingers"])

    def run(self, place: Workplace) -> HandAnswer:
        """Check the hand, and return the answer. All files are in the folder `place`."""
        name = place.hand("hand", self.hand)
        chosen = "default" if self.fingers == "auto" else self.fingers
        faults = list_faults(name, chosen)
        if faults:
            return HandAnswer(sound=False, faults=faults)
        try:
            hand = check_hand(name, chosen)
        except GraspError as error:  # a law of kinematics that the hand breaks
            return HandAnswer(sound=False, faults=(str(error),))
        joints = random_joints(hand, TRIAL.postures)
        return HandAnswer(
            sound=True,
            faults=(),
            sets={one.source.option: one.finger_names for one in finger_sets(hand, "auto")},
            joints=hand.joint_names,
            description=describe(hand, joints),
            abilities=hand_abilities(hand, TRIAL.postures).content(),
            notes=(*list_unusual(hand), *find_warnings(hand, joints)),
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class _GraspTool(Tool):
    """Arguments of a tool that reads a planned grasp."""

    grasps: str = required(GRASPS_HELP)
    rank: Rank = option(0, RANK_HELP)
    hand: str | None = option(None, "folder of a hand that is not shipped")

    def read(self, place: Workplace) -> tuple[Grasps, Hand, Path]:
        """Return the grasp as a batch of one, its hand, and the path of the surface of its plan."""
        path = place.file("grasps", self.grasps)
        with naming(path="grasps"):
            grasps = load_grasps(path)
        good = grasps.executable
        if not self.rank < len(good):
            wanted = f"a rank below {len(good)}, the number of executable grasps in the file"
            raise BadArgument("rank", self.rank, wanted)
        named = grasps.meta.get("hand", "")
        if self.hand is None and named and named not in list_hands():
            # a name in the file could be that of any folder
            wanted = f"the folder of the {named} hand below {place.root}, as it is not shipped"
            raise BadArgument("hand", "none", wanted)
        hand = None if self.hand is None else place.hand("hand", self.hand)
        surface = place.place("grasps", place.tell(path.with_name(SURFACE)))
        return good[self.rank : self.rank + 1], hand_of(grasps, hand), surface


@checked
@dataclasses.dataclass(frozen=True, kw_only=True)
class CloseInSimulation(_GraspTool):
    """Close the hand on the true object in simulation, lift it and hold it; tell whether it held.

    Needs a simulator, the true mesh in the frame of the planned cloud, and a grasp of a plan.
    """

    mesh: str = required(MESH_HELP)
    mass: Mass = option(0.25, f"mass of the object [kg]: {OR_TEXT}")
    friction: Friction = option(
        0.8, f"coefficient of friction between fingertips and object: {OR_TEXT}"
    )
    hold_time: Annotated[float, Range(0.0, BOUNDS.hold)] = option(
        2.0, "time for which the raised object is held [s]"
    )
    simulator: Simulator = option("sapien", "the simulator")
    seed: Seed = option(0, "random seed of the noise of the touch sensors")

    def run(self, place: Workplace) -> CloseAnswer:
        """Simulate the closing, and return the answer. All files are in the folder `place`."""
        grasp, hand, felt = self.read(place)
        file = place.mesh("mesh", self.mesh)
        import_simulator(self.simulator)
        mesh, parts = read_true_mesh(file)
        spec = TrialSpec(
            friction=law_of("friction", self.friction),
            mass=law_of("mass", self.mass),
            hold_time=self.hold_time,
            simulator=self.simulator,
        )
        plane = table_under(mesh, grasp.table)
        field = None
        if felt.is_file():
            surface = _read_surface(felt)
            field = field_from_surface(surface.vertices, surface.faces, FIELD_SPACING)
        result = close_hand(
            grasp, hand, mesh, spec, seed=self.seed, parts=parts, table=plane, surface=field
        )
        name = object_name(file)
        held = f"The {hand.name} hand held the {name}."
        lost = f"The {hand.name} hand did not hold the {name}: {result.status.sentence}."
        return CloseAnswer(
            held=result.held,
            status=result.status.name,
            sentence=held if result.held else lost,
            touched=tuple(hand.finger_names[k] for k in result.contact_order),
            time=float(result.time[-1]),
            simulator=self.simulator,
            rise=result.rise,
            slip=result.slip.distance,
            slip_angle=result.slip.angle,
        )


def _read_surface(path: Path) -> Surface:
    """Return a closed mesh as a surface without uncertainty."""
    mesh = read_mesh(path)
    vertices = real(mesh.vertices)
    faces = torch.from_numpy(np.array(mesh.faces))
    return Surface(vertices, faces, real(mesh.vertex_normals), torch.zeros(len(vertices)))


@checked
@dataclasses.dataclass(frozen=True, kw_only=True)
class ShowGrasp(_GraspTool):
    """Return a picture of the hand at a planned grasp on the object, with the planned contacts.

    The object is the estimated surface of the plan, or a mesh. Each finger has its colour.
    """

    mesh: str | None = option(None, f"{MESH_HELP}; by default the surface that the plan estimated")
    turn: Annotated[float, Range(-360.0, 360.0)] = option(
        0.0, "angle about the vertical by which the camera is moved aside [degrees]"
    )

    def run(self, place: Workplace) -> PictureAnswer:
        """Draw the grasp, and return the answer. All files are in the folder `place`."""
        grasp, hand, estimated = self.read(place)
        file = estimated if self.mesh is None else place.mesh("mesh", self.mesh)
        if not file.is_file():
            raise BadArgument("mesh", "none, and no surface.ply beside the grasps", MESH_HELP)
        surface = _read_surface(file)
        upright = inverse(upright_frame(surface.vertices, None, grasp.table))
        stood = move(grasp, upright)
        table = upright_table(grasp.table, inverse(upright))
        eye = rotated(facing(stood), self.turn)
        picture = draw_grasp(move(surface, upright), hand, stood, eye, table)
        what = "estimated surface" if self.mesh is None else "mesh"
        fingers = ", ".join(hand.finger_names)
        caption = (
            f"The {hand.name} hand at grasp {self.rank} on the {what} of the object; predicted "
            f"success {format_success(grasp)}; fingers {fingers}."
        )
        return PictureAnswer(caption=caption, picture=picture)


@checked
@dataclasses.dataclass(frozen=True, kw_only=True)
class TellHealth(Tool):
    """Tell the version, the folder, the shipped hands and objects, and the installed simulators."""

    def run(self, place: Workplace) -> HealthAnswer:
        """Return the version, folder, hands, objects and simulators, without importing a simulator.

        `place` is the folder of all files. The server adds `busy` and `seconds` to the answer.
        """
        return HealthAnswer(
            version=__version__,
            folder=str(place.root),
            hands=list_hands(),
            objects=list_objects(),
            simulators=tuple(name for name in SIMULATORS if importlib.util.find_spec(name)),
            gpu=torch.cuda.is_available(),
        )


TOOLS: dict[str, type[Tool]] = {
    "plan_grasps_from_point_cloud": PlanFromCloud,
    "plan_grasps_from_depth": PlanFromDepth,
    "plan_grasps_from_mesh": PlanFromMesh,
    "explain_empty": ExplainEmpty,
    "check_cloud": CheckCloud,
    "check_hand": CheckHand,
    "close_in_simulation": CloseInSimulation,
    "show": ShowGrasp,
    "health": TellHealth,
}
"""The tools by name."""


def make_tool(name: str, given: dict[str, Any]) -> Tool:
    """Return the tool called `name`, with the arguments that an agent has `given`, from JSON.

    Lists become tuples.

    Raises `BadArgument` for an unknown tool, and for unknown or missing arguments. Raises it also
    for values of another type or outside their bounds.

    >>> make_tool("check_hand", {"hand": "barrett"})
    CheckHand(hand='barrett', fingers='default')
    """
    if name not in TOOLS:
        raise BadArgument("tool", repr(name), f"one of {', '.join(TOOLS)}")
    fields = {field.name: field for field in dataclasses.fields(TOOLS[name])}  # pyright: ignore[reportArgumentType]
    for key in given:
        if key not in fields:
            raise BadArgument(key, f"an argument that {name} lacks", f"one of {', '.join(fields)}")
    for key, field in fields.items():
        if field.default is dataclasses.MISSING and key not in given:
            raise BadArgument(key, "nothing", field.metadata["help"])
    listed = {
        key: tuple(value) if isinstance(value, list) else value for key, value in given.items()
    }
    return TOOLS[name](**listed)
