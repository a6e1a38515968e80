"""The command `torchgrasp mcp`: the library as tools for agents."""

import dataclasses
from pathlib import Path
from typing import Annotated

from torchgrasp.app.cli.command import Command, arguments, option, required
from torchgrasp.foundation.rules import Range


@dataclasses.dataclass(frozen=True)
class ServerBounds:
    """Limits of the server of `torchgrasp mcp`: times, sizes of requests, ports."""

    seconds: float = 300.0  # longest time of a call [s]: most take less than a minute
    longest: float = 3600.0  # longest time that a user may allow [s]
    beat: float = 3.0  # time between two reports of progress [s]; clients give up after 30 or more
    request: int = 256 * 1024  # largest request by HTTP [bytes]: arguments are names and numbers
    last_port: int = 65_535  # largest number of a port
    chunk: int = 65_536  # greatest number of bytes that are read from stdin at once


SERVER = ServerBounds()


@arguments(folder="folder")
class ServeAgents(Command):
    """Offer planning, checks, simulation and pictures as tools to agents, by the Model Context
    Protocol.

    Needs the extra `mcp`. Tools read and write files below --folder alone. See docs/agents.md.
    """

    folder: Path = required("folder of all files that tools read and write")
    http: int | None = option(
        None,
        "port for HTTP, at /mcp on this machine alone; 0 takes a free port. By default stdin and "
        "stdout, for an agent that starts the command",
    )
    seconds: Annotated[float, Range(1.0, SERVER.longest)] = option(
        SERVER.seconds, "longest time of a call [s]; a longer one is ended"
    )

    def run(self) -> int:
        """Serve until the client ends the session, or until a signal; return the exit code 0."""
        # its tools take a while to import, and no other command needs them
        from torchgrasp.app.cli.agent_server import serve

        return serve(self.folder, self.http, self.seconds)
