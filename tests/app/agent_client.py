"""A client of `torchgrasp mcp` by the SDK's own means; it runs in .beside/mcp.

Reads JSON from stdin: the words of the command that is the server, or its address, and calls as
[tool, arguments, seconds or null]. Calls with seconds are cancelled after them. Prints JSON: the
listed tools and a result for each call.
"""

import json
import os
import sys


async def ask(server, calls):
    import anyio
    import mcp

    if not isinstance(server, str):
        command, *words = server
        server = mcp.StdioServerParameters(command=command, args=words, env=dict(os.environ))
    results = []
    async with mcp.Client(server) as client:
        tools = (await client.list_tools()).tools
        for name, arguments, seconds in calls:
            beats = []

            async def count(done, total, message, beats=beats):
                beats.append(done)

            with anyio.move_on_after(seconds):
                said = await client.call_tool(name, arguments, progress_callback=count)
                results.append(
                    {
                        "error": said.is_error,
                        "text": said.content[-1].text,
                        "data": said.structured_content,
                        "pictures": [x.data for x in said.content if x.type == "image"],
                        "beats": len(beats),
                    }
                )
                continue
            results.append(None)
    listed = {
        x.name: {"said": x.description, "given": x.input_schema, "answered": x.output_schema}
        for x in tools
    }
    return {"tools": listed, "results": results}


if __name__ == "__main__":
    import anyio

    print(json.dumps(anyio.run(ask, *json.load(sys.stdin))))
