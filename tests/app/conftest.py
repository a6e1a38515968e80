"""Ways to run the command line in tests."""

import functools
import threading
from collections.abc import Callable, Iterator

import pytest

from torchgrasp.app import cli
from torchgrasp.hand.collision_shapes import collision_pairs
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import hands_folder, load_hand

SHIPPED = {path.name for path in hands_folder().iterdir()}
read_once = functools.cache(load_hand)


def load_shipped_once(hand: str, fingers: str = "default") -> Hand:
    """Return a hand; a shipped one is read once for all commands."""
    return (read_once if hand in SHIPPED else load_hand)(hand, fingers)


@pytest.fixture(scope="module", autouse=True)
def plans_once(kept_plans: None) -> Iterator[None]:
    """Estimate the shape of each object, plan for each request, and read each shipped hand once for
    all commands.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torchgrasp.app.cli.inputs.load_hand", load_shipped_once)
        yield


@pytest.fixture
def few_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Find the pairs of links that can collide in fewer random postures, which take most of the time
    of a draft.
    """
    few = functools.partial(collision_pairs, n=2000)
    monkeypatch.setattr("torchgrasp.app.author.draft.collision_pairs", few)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write an empty picture of a hand, which takes as long to draw as all checks of the hand."""
    monkeypatch.setattr("torchgrasp.app.cli.hands.draw_hand", lambda *hand: b"")


@pytest.fixture
def run_command(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[int, str, str]]:
    """Return a function that runs a command, and returns its exit code and what it printed on
    stdout and stderr.

    No line says how far a command is, however slow the machine.
    """
    monkeypatch.setattr("torchgrasp.app.cli.command.BEAT", threading.TIMEOUT_MAX)

    def run(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        code = cli.main([str(word) for word in words])
        return code, *capsys.readouterr()

    return run


@pytest.fixture
def refusal(run_command: Callable[..., tuple[int, str, str]]) -> Callable[..., str]:
    """Return a function that runs a command that must be refused in one sentence, and returns the
    sentence.
    """

    def run(*words: object) -> str:
        code, out, err = run_command(*words)
        assert (code, out) == (2, "") and "Traceback" not in err
        assert (
            err.startswith("torchgrasp: ")
            and err.count("\n") == 1
            and "expected" in err
            and ", got " in err
        )
        return err.removeprefix("torchgrasp: ")

    return run
