"""Limits of the server of `torchgrasp mcp`."""

import dataclasses


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
