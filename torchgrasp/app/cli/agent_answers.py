"""The answers of the tools for agents, as records with the meaning and unit of each field."""

import dataclasses
from typing import Any

from torchgrasp.app.cli.command import option, required
from torchgrasp.files import plain_value

Vector = tuple[float, float, float]
DIGITS = 6  # decimals of numbers in answers [m, rad]: micrometres


@dataclasses.dataclass(frozen=True, kw_only=True)
class Answer:
    """Base of the answers of the tools that `torchgrasp mcp` offers to AI agents.

    `picture` holds the bytes of a PNG, or None for no picture. It is sent beside the other fields,
    not as text.
    """

    notes: tuple[str, ...] = option((), "what was noticed, such as advice for a better cloud")
    picture: bytes | None = dataclasses.field(default=None, repr=False)


@dataclasses.dataclass(frozen=True, kw_only=True)
class GraspRow:
    """A grasp that passed all checks: pose [m] of the hand in the frame of the cloud, and joint
    positions [rad] by name.
    """

    rank: int = required("0 is the best")
    success: float | None = required(
        "predicted probability that the object is lifted and held; null if it is unknown"
    )
    interval: tuple[float, float] | None = required(
        "bounds of the share of such grasps that held in trials (95 % over families of objects)"
    )
    position: Vector = required("origin of the hand's root link in the frame of the cloud [m]")
    quaternion_wxyz: tuple[float, float, float, float] = required(
        "rotation of the hand's root link in the frame of the cloud, a unit quaternion w x y z"
    )
    approach: Vector = required("unit direction in which the opened hand comes to its pose")
    rise: Vector = required(
        "displacement [m] of the opened hand from its pose, until it closes. It is not zero where "
        "the hand would be in the table"
    )
    pregrasp: dict[str, float] = required("positions of all joints of the opened hand [rad]")
    grasp: dict[str, float] = required("positions at which the fingertips touch [rad]")
    squeeze: dict[str, float] = required("targets of position-controlled joints that press [rad]")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ThingRow:
    """An object of a scene, and what planning found for it."""

    label: int = required("label of the object")
    success: float | None = required("predicted success of its best grasp; null if it is unknown")
    reason: str = required("why it has no grasp; empty if it has one")


@dataclasses.dataclass(frozen=True, kw_only=True)
class LookRow:
    """A camera from which a second view would make the estimated surface more certain.

    The standard deviations are those of the surface, as means over the contacts of the grasps.
    """

    obj_from_camera_m: tuple[tuple[float, ...], ...] = required(
        "pose of the camera in the frame of the grasps, 4 x 4: x right, y down, z forward"
    )
    turn_deg: float | None = required("angle to the nearest earlier camera; null if none is known")
    std_before_m: float = required("mean standard deviation of the surface now [m]")
    std_after_m: float = required("the same as expected with the second view [m]")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanAnswer(Answer):
    """The result of planning. Without an executable grasp, `explain_empty` says what would help."""

    verdict: str = required("the result in a sentence")
    hand: str = required("name of the hand")
    fingers: tuple[str, ...] = required("names of the fingers that grasp")
    executable: int = required("number of grasps that passed every check")
    planned: int = required("number of postures that were checked")
    grasps: tuple[GraspRow, ...] = required("the best executable grasps, the best first")
    lowers_success: tuple[str, ...] = option((), "what lowers the success of the best grasp most")
    look_next: LookRow | None = option(None, "from where a second view would raise the success")
    objects: tuple[ThingRow, ...] = option((), "objects of the scene, if none was chosen")
    grasps_file: str | None = option(None, "all grasps, for close_in_simulation and show")
    json_file: str | None = option(None, "the listed grasps with contacts, forces and torques")
    surface_file: str | None = option(None, "the estimated surface of the object [m]")
    seen_file: str | None = option(None, "the cloud or scene that was planned on")
    pages: tuple[str, ...] = option((), "pages for a person: a report, and the grasp in 3D")


@dataclasses.dataclass(frozen=True, kw_only=True)
class LossRow:
    """A stage of planning, and how many candidates, such as postures, it lost and why."""

    stage: str = required("name of the stage")
    given: int = required("number of things that it was given")
    kept: int = required("number of things that it kept")
    things: str = required("word for these things")
    reasons: dict[str, int] = required("number of lost things, by the sentence that says why")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ChangeRow:
    """A change of the options or of the world, and the grasps that planning found with it."""

    change: str = required("the change in words")
    choice: bool = required("whether the user can make it; otherwise it changes the world")
    executable: int = required("number of executable grasps with it")
    expected: float = required("mean predicted success of the best grasps with it")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExplainAnswer(Answer):
    """Why a plan has no grasp, and which single change would help most."""

    advice: str = required("what would help most, in a sentence")
    starts: int = required("number of initial guesses of each plan")
    stages: tuple[LossRow, ...] = required("where grasps were lost")
    changes: tuple[ChangeRow, ...] = required("changes that were tried, the most helpful first")


@dataclasses.dataclass(frozen=True, kw_only=True)
class AdviceRow:
    """A fault of a point cloud and what mends it."""

    found: str = required("the fault")
    fix: str = required("what mends it")
    refused: bool = required("whether no grasp is planned on such a cloud")


@dataclasses.dataclass(frozen=True, kw_only=True)
class CloudAnswer(Answer):
    """The measured quality of a point cloud, and advice for a better one."""

    usable: bool = required("whether grasps are planned on the cloud")
    advice: tuple[AdviceRow, ...] = required("faults of the cloud; refusals come first")
    points: int = required("number of points")
    size: Vector = required("sides of the box along the axes [m]")
    spacing: float = required("median distance to the nearest point [m]")
    noise: float = required("median noise about local planes [m]")
    outliers: int = required("number of points far from the others")
    camera_given: bool = required("whether the camera's position is given; else it is estimated")


@dataclasses.dataclass(frozen=True, kw_only=True)
class HandAnswer(Answer):
    """The faults of a hand or, if it has none, what it is."""

    sound: bool = required("whether the hand has no fault")
    faults: tuple[str, ...] = required("every fault, with its fix")
    sets: dict[str, tuple[str, ...]] | None = option(
        None, "fingers of each declared set, by its name"
    )
    joints: tuple[str, ...] = option((), "names of the actuated joints")
    description: str = option("", "joints, fingers and random postures in words")
    abilities: dict[str, Any] | None = option(
        None,
        "what the chosen fingers can do, as abilities.json of `hand check`: widths [m], spans [m] "
        "and forces at the tips [N]. Units are in the names",
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class CloseAnswer(Answer):
    """The result of closing the hand on the true object in simulation, lifting and holding it."""

    held: bool = required("whether the object was lifted with the hand and slipped little")
    status: str = required("name of the outcome")
    sentence: str = required("the result in a sentence")
    rise: float | None = required("height by which the object rose [m]")
    slip: float | None = required("distance by which it moved in the closed hand [m]")
    slip_angle: float | None = required("angle by which it turned in the closed hand [rad]")
    touched: tuple[str, ...] = required("fingers that touched, in the order of first contacts")
    time: float = required("simulated time [s]")
    simulator: str = required("name of the simulator")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PictureAnswer(Answer):
    """A picture of a hand on its object."""

    caption: str = required("what the picture shows")


@dataclasses.dataclass(frozen=True, kw_only=True)
class HealthAnswer(Answer):
    """The state of the server."""

    version: str = required("version of torchgrasp")
    folder: str = required("the folder of all files")
    hands: tuple[str, ...] = required("names of the shipped hands")
    objects: tuple[str, ...] = required("names of the shipped objects, each with a view and a mesh")
    simulators: tuple[str, ...] = required("installed simulators")
    gpu: bool = required("whether a graphics card is visible; no tool needs one")
    busy: bool = option(False, "whether a call is being worked on; others wait")
    seconds: float = option(0.0, "longest time of a call [s]")


def plain_answer(answer: Answer) -> dict[str, Any]:
    """Return the fields of an answer, but for its picture, as a dict for JSON.

    Numbers are rounded to 6 decimals; NaN and infinity become None.
    """
    named = dict(vars(answer))
    del named["picture"]
    return plain_value(named, DIGITS)
