"""Python in processes of their own, which have imported the library and nothing of the tests.

They are copies of the process from which all workers of the library come, and so begin at once.
"""

import contextlib
import io
import logging

from torchgrasp.foundation import fused
from torchgrasp.foundation.jobs import run_tasks


def execute(code: str) -> str:
    """Run a text of Python; return what it says on either stream."""
    # whether loops are compiled, or loaded from the disk, depends on the tests before
    logging.getLogger(fused.__name__).setLevel(logging.ERROR)
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        exec(code, {"__name__": "apart"})
    return said.getvalue()


def run_apart(*codes: str) -> list[str]:
    """Run texts of Python at once, each in a process of its own; return what each says."""
    return list(run_tasks(execute, [(code,) for code in codes], workers=len(codes), limit=600.0))
