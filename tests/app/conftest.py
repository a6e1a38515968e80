"""Ways to run the command line in tests."""

from collections.abc import Callable

import pytest

from torchgrasp.app import cli


@pytest.fixture(scope="module", autouse=True)
def plans_once(kept_plans: None) -> None:
    """Estimate the shape of each object, and plan for each request, once for all commands."""


@pytest.fixture
def run_command(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Return a function that runs a command, and returns its exit code and what it printed on
    stdout and stderr.
    """

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
