"""The errors of torchgrasp, and the status of each row of a batch.

A bad argument raises a subclass of `GraspError` at the public function, before any work. A failed
row of a batch does not raise: it has a `Status`, which explains the failure in a sentence.
"""

import copyreg
import difflib
import enum
import re
from typing import Any

from torchgrasp.foundation.limits import MESSAGE_LETTERS


class GraspError(Exception):
    """Base class of all errors of torchgrasp.

    Its text says what was expected, what was given, and in which argument or file.

    >>> from torchgrasp import load_hand
    >>> try:
    ...     load_hand("octopus")
    ... except GraspError as error:
    ...     print(type(error).__name__)
    HandFileError
    """

    def __reduce__(self) -> tuple[Any, ...]:
        """Support pickling, so that worker processes can return the error."""
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # pyright: ignore[reportAttributeAccessIssue]


class BadArgument(GraspError, ValueError):
    """An argument has a wrong shape, type or range.

    `argument` is its name, `found` what was given, and `allowed` a text that says what is expected.
    The message holds all three. For a misspelt word it names the nearest allowed one.
    """

    def __init__(self, argument: str, found: object, allowed: str):
        parts = (argument, str(found), allowed)
        named, shown, wanted = (
            x if len(x) <= MESSAGE_LETTERS else f"{x[:MESSAGE_LETTERS]}..." for x in parts
        )
        super().__init__(f"{named}: expected {wanted}, got {shown}{_suggest(shown, allowed)}")
        self.argument = argument
        self.found = found
        self.allowed = allowed


def one_line(told: object) -> str:
    """Return the text of an error, a warning or any object as one line, without line breaks and
    double spaces.
    """
    return " ".join(str(told).split())


def _suggest(found: str, allowed: str) -> str:
    """Return a text that names the word of `allowed` nearest to a quoted word that was found.

    The text is empty for anything but a quoted word, and where no word is near.
    """
    quoted = re.match(r"'([A-Za-z_-]+)'(?:$|,)", found)
    if quoted is None:
        return ""
    words = set(re.findall(r"[A-Za-z_-]+", allowed)) - {quoted[1]}
    near = difflib.get_close_matches(quoted[1], sorted(words), 1)
    return f"; did you mean {near[0]}?" if near else ""


class TooFewPoints(BadArgument):
    """A cloud has too few points to estimate a surface. Most functions need at least 4 distinct
    points.
    """


class SuspiciousScale(BadArgument):
    """A cloud or a mesh is too small or too large to grasp. Mostly it is under 5 mm or over 2 m,
    and its unit may be millimetres.
    """


class NoSupport(BadArgument):
    """No plane is found on which the objects of a scene stand."""


class CloudFileError(BadArgument):
    """A file of a cloud or scene is missing or empty, or its content does not fit its suffix."""


class MeshError(BadArgument):
    """A mesh is missing, malformed, open or without volume, or the convex parts of a body do not
    fit it.
    """


class HandFileError(BadArgument):
    """A URDF or hand.toml is missing, malformed or not supported, or refers to files outside its
    folder.
    """


class ModelFileError(BadArgument):
    """A file of stored results, such as grasps or a model, is missing, malformed, or of another
    kind.
    """


class DatasetError(BadArgument):
    """A folder lacks the objects or meshes asked for, or its manifest is malformed or names files
    outside it.
    """


class OutputError(BadArgument):
    """An output folder or file cannot be written, is in use, or holds something else."""


class MissingExtra(GraspError, ImportError):
    """A package that an optional feature needs is not installed.

    `package` is its name, and `extra` the extra of torchgrasp that installs it. The message names
    both. `asked` is a setting that needs the package, such as "TORCHGRASP_FUSED=1"; it is empty if
    the call itself shows the need.
    """

    def __init__(self, package: str, extra: str, asked: str = ""):
        needed = f"{asked} needs {package}, which" if asked else package
        super().__init__(f"{needed} is not installed: pip install 'torchgrasp[{extra}]'")
        self.package = package
        self.extra = extra


class NoWorkers(GraspError, RuntimeError):
    """No worker process can start."""

    def __init__(self) -> None:
        fix = 'workers=0, or in a script `if __name__ == "__main__":` around the call'
        super().__init__(
            f"no worker process can start; the standard error says why. What may help: {fix}"
        )


class IndefiniteCovariance(GraspError, ValueError):
    """A covariance matrix is not positive definite; `smallest_eigenvalue` is its least eigenvalue.

    The library never adds a multiple of the identity (jitter) to make a matrix positive definite.
    The message names the matrix (`what`) and a remedy (`fix`).
    """

    def __init__(self, what: str, smallest_eigenvalue: float, fix: str):
        super().__init__(
            f"{what} is not positive definite (smallest eigenvalue "
            f"{smallest_eigenvalue:.3g}): {fix}"
        )
        self.smallest_eigenvalue = smallest_eigenvalue


class DegenerateContacts(GraspError, ValueError):
    """Three contacts lie on a line or in a point, so they define no coordinate frame."""


class BrokenLaw(GraspError, AssertionError):
    """The kinematics of a hand break a law, a property of all hands that `check_hand` tests.

    The attribute `law` is the name of the law.

    >>> error = BrokenLaw("jacobian", "2 nan", "finite numbers")
    >>> error.law, str(error)
    ('jacobian', 'jacobian: expected finite numbers, got 2 nan')
    """

    def __init__(self, law: str, found: str, allowed: str):
        super().__init__(f"{law}: expected {allowed}, got {found}")
        self.law = law


class FailedRows(GraspError):
    """Rows of a batch failed, such as some grasps; `Batch.raise_for_status` raises this error."""


class CloudWarning(UserWarning):
    """Base class of warnings that a cloud shows its object badly; the message says how."""


class MendedInput(UserWarning):
    """An input has a small fault, and was read with the fault mended; the message names both."""


class NoEffect(UserWarning):
    """An argument changes nothing, most often because it is in another frame or unit."""


class CutOff(CloudWarning):
    """The object reaches the border of the image, so a part of it may be missing."""


class Gap(CloudWarning):
    """A region within the object's outline in the image has no points: a hole, or a reflecting
    patch.
    """


class TwoBodies(CloudWarning):
    """The cloud or the mesh shows two separate bodies."""


class TableLeft(CloudWarning):
    """The cloud holds points of the table around its object, which count as the object."""


class FewPoints(CloudWarning):
    """The cloud has too few points to show a shape: fewer than 100."""


class Flat(CloudWarning):
    """All points of the cloud lie in one plane, so the estimated thickness is a guess."""


class GraspFileWarning(UserWarning):
    """A file of grasps was read, but values were left out or changed, or seem to have reversed
    signs.
    """


class Status(enum.IntEnum):
    """The outcome of one row of a batch, such as one grasp: success, or the reason of a failure.

    A status is an integer: 0 (`OK`) means success, other values are failures. Its `name`, such as
    "NOT_CLOSED", is short, and its `sentence` explains it. `Status(int(code))` turns an entry of
    a `status` tensor into one.

    >>> Status.NOT_CLOSED.sentence
    'the contacts do not resist every wrench at the planned friction (no frictional form closure)'
    """

    sentence: str

    def __new__(cls, code: int, sentence: str) -> "Status":
        """Make a status from its integer code and its sentence."""
        member = int.__new__(cls, code)
        member._value_ = code
        member.sentence = sentence
        return member

    OK = 0, "all checks passed"
    # planning
    OUT_OF_DOMAIN = 10, "a contact lies outside the ball in which the shape model holds"
    OFF_SURFACE = 11, "a contact is not on the estimated surface"
    TOO_UNCERTAIN = 12, "the shape at a contact is less certain than max_variance allows"
    NOT_CLOSED = (
        13,
        "the contacts do not resist every wrench at the planned friction (no frictional "
        "form closure)",
    )
    TOO_CLOSE = 14, "two fingertips on their contacts would overlap"
    NOT_FLAT = 15, "the surface around a contact bends too sharply for a fingertip"
    BELOW_TABLE = 16, "a fingertip on its contact would be below the table"
    DEGENERATE = 17, "the contacts lie on a line or in a point: they span no virtual frame"
    OUTSIDE = 18, "a contact lies outside the region where contacts may be (`keep`, `avoid`)"
    NOT_RESISTED = (
        19,
        "the fingers' forces on the contacts do not resist a wrench of the task (`resist`)",
    )
    # hand configuration
    OUT_OF_REACH = 20, "no posture of this hand spans the contacts"
    TIP_ERROR = 21, "a fingertip does not reach its contact"
    NORMAL_ANGLE = 22, "a fingertip would touch outside its pad"
    JOINT_LIMITS = 23, "a joint would leave its limits"
    SELF_COLLISION = 24, "links of the hand would collide with each other"
    OBJECT_COLLISION = 25, "a link of the hand would penetrate the object"
    TABLE_COLLISION = 26, "a link of the hand would penetrate the table"
    PREGRASP = 27, "the hand cannot open at this pose without touching something"
    NO_APPROACH = 28, "the opened hand cannot come straight to this pose without touching something"
    NEIGHBOUR_COLLISION = (
        29,
        "a link of the hand would touch a neighbour of the object, or space that may be full",
    )
    UNREACHABLE = 30, "the arm cannot bring the hand to this pose (`reachable` refuses it)"
    BURIED = 31, "something lies on the object or leans over it"
    NO_PROMISE = (
        39,
        "the predicted success is less than the promise needs: give a lower one, or add "
        "a second view",
    )
    # the object in its picture, before it is planned
    FEW_PIXELS = 32, "too few pixels show the object: bring the camera nearer"
    OFF_TABLE = 33, "the object is not over the table: give the table that it stands on"
    CUT_OFF = (
        34,
        "the border of the image cuts off a side that fingers need: turn the camera to the object",
    )
    NO_DEPTH = (
        35,
        "most of the object has no depth, as glass or a mirror: coat it matt, or look "
        "from another side",
    )
    TOO_LOW = (
        36,
        "the object is lower than fingertips on the table need: take a hand with smaller "
        "fingertips",
    )
    TOO_WIDE = (
        37,
        "the object is wider than the hand spans: take a larger hand, or choose the "
        "object to plan anyway",
    )
    TOO_VAGUE = (
        38,
        "the shape may be off by more than half the object: add a second view, or bring "
        "the camera nearer",
    )
    # closing
    START_OVERLAP = 40, "the hand overlaps the object or the table before closing starts"
    NO_CONTACT = 41, "a fingertip never touched the object"
    DROPPED = 42, "the object was lifted and lost"
    NOT_LIFTED = 43, "the object stayed behind when the hand was lifted"
    EJECTED = 44, "the object was pushed out while the hand closed"
    UNSTABLE = 45, "the simulation did not stay finite"
    MOVED = 46, "the object moved or turned too far while it was pulled, counting the closing"
    TOO_WEAK = 47, "the hand's drives were at their largest torque and the object was not held"
    SLIPPED = 48, "the object was lifted, but slipped or turned too far in the hand"
    TOO_HEAVY = (
        49,
        "the object is heavier than the hand can hold at the friction it felt, and was put down",
    )
    # the run
    BAD_OBJECT = 60, "the files of the object are not what they should be"
    TIMED_OUT = 61, "it took longer than its limit and was ended"
    WORKER_DIED = 62, "the process that worked on it died, in each attempt"
    BROKEN = 63, "an error within the library ended the work on it"
