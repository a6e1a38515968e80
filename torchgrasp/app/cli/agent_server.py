"""The server of `torchgrasp mcp`: the library as tools for agents, by the Model Context Protocol.

Each call is worked on in a process of its own kind. The process is ended at the time limit or when
the client cancels the call. It also keeps what libraries print away from the protocol. One call is
worked on at a time.
"""

import base64
import contextlib
import dataclasses
import importlib
import json
import os
import re
import signal
import socket
import sys
import threading
import traceback
import types
import typing
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import torch

from torchgrasp import __version__
from torchgrasp.app.cli.agent_answers import Answer, plain_answer
from torchgrasp.app.cli.agent_files import Workplace
from torchgrasp.app.cli.agent_tools import TOOLS, TellHealth, Tool, make_tool
from torchgrasp.app.cli.command import naming
from torchgrasp.app.cli.server_bounds import SERVER
from torchgrasp.foundation.errors import BadArgument, GraspError, one_line
from torchgrasp.foundation.lazy import import_extra
from torchgrasp.foundation.rules import Range

HOST = "127.0.0.1"  # HTTP is served to programs of this machine alone
OPTION = re.compile(r"--([a-z][a-z-]*)")
LIBRARY = "torchgrasp "  # a sentence with a command line keeps its options
NAMES = {"CLOUD": "cloud", "FILE": "cloud"}
"""Arguments of tools, by the names of the command line."""
GUIDE = """Plans grasps of multi-fingered hands from one partial view of an object, and tells how \
likely each is to hold. Lengths are metres, angles radians, unless a name says otherwise. Files are \
named by paths below one folder, which `health` tells; names of shipped hands and objects work, \
too. First `check_cloud`, then a plan, then `show` and `close_in_simulation` with the file that the \
plan wrote. If a plan has no executable grasp, `explain_empty` with the same arguments says what \
would help."""
"""What an agent is told of the server."""


def serve(folder: Path, http: int | None, seconds: float) -> int:
    """Offer the library as tools to agents, by the Model Context Protocol; return the exit code 0.

    The server ends when the client ends the session, or at a signal. Raises `MissingExtra` without
    the package `mcp`, and `BadArgument` for a folder or port that cannot be used.

    Args:
        folder: the folder of all files that tools read and write.
        http: port for HTTP, 0 for a free one; None means stdin and stdout.
        seconds: longest time of a call [s].
    """
    server = AgentServer(Workplace.at(folder), seconds)
    runs = importlib.import_module("anyio")
    if http is None:
        with _stdin_that_ends():
            runs.run(server.serve_stdio)
        return 0
    with bind_port(http) as port:
        runs.run(server.serve_http, port)
    return 0


def bind_port(number: int) -> socket.socket:
    """Return a socket on the port `number`, for programs of this machine alone; 0 takes a free
    port.

    Raises `BadArgument`, which names --http, for a number that is no port, or a port in use.
    """
    if not 0 <= number <= SERVER.last_port:
        raise BadArgument("--http", number, f"a port up to {SERVER.last_port}, or 0 for any")
    try:
        return socket.create_server((HOST, number))
    except OSError as error:
        found = f"{number} ({os.strerror(error.errno or 0)})"
        raise BadArgument("--http", found, "a free port, or 0 for any") from error


class AgentServer:
    """A server of the Model Context Protocol (MCP) that offers torchgrasp's tools to AI agents.

    Raises `MissingExtra` without the package `mcp`.

    Args:
        place: the folder in which tools read and write all files.
        seconds: longest time of a call [s].
    """

    def __init__(self, place: Workplace, seconds: float) -> None:
        import_extra("mcp", "mcp", "mcp")
        self.place = place
        self.seconds = seconds
        self.anyio: Any = importlib.import_module("anyio")
        self.workers: Any = importlib.import_module("anyio.to_process")
        self.types: Any = importlib.import_module("mcp.types")
        self.turn: Any = self.anyio.CapacityLimiter(1)
        lowlevel: Any = importlib.import_module("mcp.server.lowlevel")
        self.server: Any = lowlevel.Server(
            "torchgrasp",
            version=__version__,
            instructions=GUIDE,
            on_list_tools=self.list_tools,
            on_call_tool=self.call_tool,
        )

    async def serve_stdio(self) -> None:
        """Answer the calls of the agent that started this process, by stdin and stdout, until stdin
        ends.
        """
        stdio: Any = importlib.import_module("mcp.server.stdio")
        # What libraries print goes to stderr: the SDK moves the descriptor of stdout.
        async with stdio.stdio_server() as (reader, writer):
            options = self.server.create_initialization_options()
            await self.server.run(reader, writer, options)

    async def serve_http(self, port: socket.socket) -> None:
        """Answer the calls of agents on this machine, by HTTP on the bound socket `port`, until a
        signal such as SIGTERM.
        """
        uvicorn: Any = importlib.import_module("uvicorn")
        security: Any = importlib.import_module("mcp.server.transport_security")
        number = port.getsockname()[1]
        # A page of another host, which a browser shows here, is refused by its Host or Origin.
        hosts = [f"{name}:{number}" for name in (HOST, "localhost")]
        settings = security.TransportSecuritySettings(
            enable_dns_rebinding_protection=True,
            allowed_hosts=hosts,
            allowed_origins=[f"http://{host}" for host in hosts],
        )
        app = self.server.streamable_http_app(
            host=HOST, transport_security=settings, max_request_body_size=SERVER.request
        )
        print(f"serving agents at http://{HOST}:{number}/mcp", file=sys.stderr, flush=True)
        config = uvicorn.Config(app, log_level="warning")
        await uvicorn.Server(config).serve(sockets=[port])

    async def list_tools(self, context: Any, params: Any) -> Any:
        """Return all tools with the JSON schemas of their arguments and answers, in MCP's format.

        The package `mcp` calls it; `context` and `params` are not used.
        """
        listed = [
            self.types.Tool(
                name=name,
                description=one_line(tool.__doc__ or ""),
                input_schema=make_schema(tool),
                output_schema=make_schema(typing.get_type_hints(tool.run)["return"]),
                annotations=self.types.ToolAnnotations(
                    read_only_hint=not name.startswith("plan"), open_world_hint=False
                ),
            )
            for name, tool in TOOLS.items()
        ]
        return self.types.ListToolsResult(tools=listed)

    async def call_tool(self, context: Any, params: Any) -> Any:
        """Run a tool, and return its answer, or its error as one sentence, in MCP's format.

        The package `mcp` calls it. `params` holds the `name` of the tool and its `arguments`.
        `context` is the client's session.
        """
        try:
            tool = make_tool(params.name, dict(params.arguments or {}))
            if isinstance(tool, TellHealth):
                found = tool.run(self.place)
                busy = self.turn.borrowed_tokens > 0
                answer = dataclasses.replace(found, busy=busy, seconds=self.seconds)
            else:
                answer = await self.work(context, tool)
        except GraspError as error:
            return self.types.CallToolResult(content=[self._text(say(error))], is_error=True)
        content = [self._text(json.dumps(plain_answer(answer)))]
        if answer.picture is not None:
            data = base64.b64encode(answer.picture).decode("ascii")
            content.insert(0, self.types.ImageContent(data=data, mime_type="image/png"))
        return self.types.CallToolResult(content=content, structured_content=plain_answer(answer))

    async def work(self, context: Any, tool: Tool) -> Answer:
        """Run a tool in another process, one tool at a time, and return its answer.

        `context` is the client's session, to which progress is reported. Raises the `GraspError`
        that the tool raises, and a `GraspError` if the process dies. Raises `BadArgument` for a
        call that takes longer than the server's `seconds`.
        """
        outcome: Answer | GraspError | None = None
        async with self.turn, self.anyio.create_task_group() as group:
            group.start_soon(self._beat, context)
            try:
                # One thread, as in the command line. A new process first imports the library, which
                # the limit does not count.
                await self.workers.run_sync(torch.set_num_threads, 1, cancellable=True)
                # the process is ended at the limit, and if the client cancels
                with self.anyio.move_on_after(self.seconds):
                    call = (do_work, tool, self.place)
                    outcome = await self.workers.run_sync(*call, cancellable=True)
            except GraspError as error:  # a group would wrap it
                outcome = error
            except self.anyio.BrokenWorkerProcess:
                outcome = GraspError("the process that worked on the call died; try again")
            group.cancel_scope.cancel()
        if isinstance(outcome, GraspError):
            raise outcome
        if outcome is None:
            found = f"one that was ended after {self.seconds:g} s"
            raise BadArgument("call", found, "a shorter one, as by fewer starts")
        return outcome

    async def _beat(self, context: Any) -> None:
        """Tell the client from time to time that the work goes on, so that it does not give up."""
        spent = 0.0
        while True:
            await self.anyio.sleep(SERVER.beat)
            spent += SERVER.beat
            await context.session.report_progress(spent, self.seconds, f"{spent:.0f} s")

    def _text(self, text: str) -> Any:
        return self.types.TextContent(text=text)


def do_work(tool: Tool, place: Workplace) -> Answer:
    """Run a tool, and return its answer, whose `notes` also hold the library's warnings.

    The server calls this function in a separate process. `place` is the folder in which the tool
    reads and writes files. Raises the `GraspError` that ended the tool. An error of another type
    becomes a `GraspError`, and its traceback is written to stderr.
    """
    with _stdout_elsewhere(), warnings.catch_warnings(record=True) as heard, naming(**NAMES):
        warnings.simplefilter("always", UserWarning)
        try:
            answer = tool.run(place)
        except (GraspError, KeyboardInterrupt):
            raise
        except Exception as error:
            traceback.print_exc(file=sys.__stderr__)
            told = f"an error within the library ended the work ({type(error).__name__}); "
            raise GraspError(f"{told}the standard error of the server tells where") from error
    notes = [str(one.message) for one in heard if issubclass(one.category, UserWarning)]
    said = tuple(dict.fromkeys(say(text) for text in (*answer.notes, *notes)))
    return dataclasses.replace(answer, notes=said)


@contextlib.contextmanager
def _stdout_elsewhere() -> Iterator[None]:
    """Within the context, send what libraries write to the descriptor of stdout to stderr.

    A worker answers by this descriptor.
    """
    kept = os.dup(1)
    try:
        os.dup2(2, 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


@contextlib.contextmanager
def _stdin_that_ends() -> Iterator[None]:
    """Within the context, stdin is a pipe that ends at SIGINT and SIGTERM, and with it the server.

    A thread of the SDK waits for stdin, so an exception would not end the process. The signal is
    raised again after the context.
    """
    source = os.dup(0)
    reader, number = os.pipe()
    os.dup2(reader, 0)
    os.close(reader)
    writer = os.fdopen(number, "wb", buffering=0)
    told = list[int]()

    def pump() -> None:
        with contextlib.suppress(OSError, ValueError), writer:  # the context may have ended
            while data := os.read(source, SERVER.chunk):
                writer.write(data)

    def end(sign: int, _: object) -> None:
        told.append(sign)
        writer.close()

    threading.Thread(target=pump, daemon=True).start()
    before = {sign: signal.signal(sign, end) for sign in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for sign, handler in before.items():
            signal.signal(sign, handler)
        writer.close()
        os.dup2(source, 0)
    if told:
        signal.raise_signal(told[0])


def say(told: GraspError | str) -> str:
    """Return an error or advice as one line, in which an option such as --depth-unit becomes
    depth_unit.

    Agents know options by these names, the arguments of tools. A line with a whole command line, as
    `torchgrasp grasp jug`, keeps its options.
    """
    line = one_line(told)
    if LIBRARY in line:
        return line
    return OPTION.sub(lambda found: found[1].replace("-", "_"), line)


def make_schema(kind: Any) -> dict[str, Any]:
    """Return the JSON schema of a type annotation, as a dict.

    `kind` is a plain type such as float, a union, tuple, dict, Literal or Annotated, or a
    dataclass. The schema of a dataclass has its fields with a help text, which describes each.

    >>> make_schema(tuple[float, float] | None)["anyOf"][0]["maxItems"]
    2
    """
    origin = typing.get_origin(kind)
    inside = typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _object_schema(kind)
    if kind is Any:
        return {}
    if origin is Annotated:
        bounds = inside[1]
        schema = make_schema(inside[0])
        if isinstance(bounds, Range):
            schema |= {"minimum": bounds.low, "maximum": bounds.high}
        return schema
    if origin is Literal:
        return {"type": "string", "enum": list(inside)}
    if origin in (typing.Union, types.UnionType):
        return {"anyOf": [make_schema(one) for one in inside]}
    if origin is tuple:
        schema = {"type": "array", "items": make_schema(inside[0])}
        if inside[-1] is not ...:
            schema |= {"minItems": len(inside), "maxItems": len(inside)}
        return schema
    if origin is dict:
        return {"type": "object", "additionalProperties": make_schema(inside[1])}
    names = {str: "string", bool: "boolean", int: "integer", float: "number"}
    return {"type": "null" if kind is type(None) else names[kind]}


def _object_schema(kind: Any) -> dict[str, Any]:
    """Return the JSON schema of a dataclass; fields without help are left out."""
    properties = dict[str, Any]()
    needed = list[str]()
    for field in dataclasses.fields(kind):
        if "help" not in field.metadata:
            continue
        schema = make_schema(field.type) | {"description": say(field.metadata["help"])}
        if field.default is dataclasses.MISSING:
            needed.append(field.name)
        elif not isinstance(field.default, tuple):
            schema["default"] = field.default
        properties[field.name] = schema
    return {
        "type": "object",
        "properties": properties,
        "required": needed,
        "additionalProperties": False,
    }
