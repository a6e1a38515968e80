"""A line for each stage of a command."""

import sys
import time
from typing import Any

from tqdm import tqdm


class Progress:
    """A line for each stage that ended; on a terminal a bar names the stage under way."""

    def __init__(self, *names: str) -> None:
        self.next = dict(zip(names, (*names[1:], "done"), strict=True))
        self.stages: list[tuple[str, str, float]] = []
        self.values: dict[str, Any] = {}
        self.began = time.perf_counter()
        # None: silent where stderr is no terminal.
        self.bar = tqdm(total=len(names), desc=names[0], leave=False, delay=1, disable=None, unit="stage")

    def end(self, name: str, message: str, value: Any = None) -> None:
        """Note the end of a stage."""
        now = time.perf_counter()
        self.stages.append((name, message, now - self.began))
        self.values[name] = value
        with self.bar.external_write_mode(sys.stdout):
            print(f"{name:8}{now - self.began:6.1f} s  {message}", flush=True)
        self.began = now
        if name in self.next:
            self.bar.update()
            self.bar.set_description(self.next[name])
