"""Tasks of worker processes, which hang, die and raise.

They have a file of their own: each worker imports the file of its task, and little else.
"""

import multiprocessing
import os
import signal
import time

import torch

from torchgrasp.foundation.errors import BadArgument


def act(what: str, value: int = 0) -> object:
    """Return a square, soon or later, hang or work without end, die in one of two ways, raise, or
    report the threads.
    """
    if what == "hang":
        time.sleep(600)
    while what == "work":
        pass
    if what == "pause":
        time.sleep(value / 1000)
    if what == "slow":
        time.sleep(0.3)
    if what == "exit":
        os._exit(3)
    if what == "KILL":
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "raise":
        raise BadArgument("value", value, "another")
    if what == "threads":
        return torch.get_num_threads()
    return value * value


def spin(seconds: float, value: int) -> int:
    """Return the value after a processor time [s]."""
    started = time.process_time()
    while time.process_time() < started + seconds:
        pass
    return value


def die_once(path: str) -> str:
    """Die at the first call, and leave a file that tells the second."""
    if not os.path.exists(path):
        open(path, "w").close()
        os.kill(os.getpid(), signal.SIGKILL)
    return "survived"


class Heavy:
    """A task whose workers die while they begin, as many times as the folder has no mark."""

    def __init__(self, folder: str, deaths: int) -> None:
        self.folder = folder
        self.deaths = deaths

    def __call__(self, value: int) -> int:
        return value * value

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__ |= state
        if multiprocessing.parent_process() is not None:
            number = len(os.listdir(self.folder))
            if number < self.deaths:
                open(os.path.join(self.folder, str(number)), "w").close()
                os._exit(7)
