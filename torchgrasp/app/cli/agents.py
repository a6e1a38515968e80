"""The command `torchgrasp mcp`: the library as tools for agents."""

from pathlib import Path
from typing import Annotated

from torchgrasp.app.cli.command import Command, arguments, option, required
from torchgrasp.app.cli.server_bounds import SERVER
from torchgrasp.foundation.rules import Range


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
