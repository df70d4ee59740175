"""A tool call of `roboneuron serve` compared with one of a minimal low-level server, both over
stdio, with one client.

    python benchmarks/bench_round_trip.py --calls 300

The client validates each answer against the listed output schema, as clients of the MCP 1.x SDK do:
    it checks the
schema and compiles a validator with every call. The minimal server only answers one field, so the
ratio shows RoboNeuron's overhead: checks of arguments, a status of four modules, and its larger
answer.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import jsonschema
from rich.console import Console
from rich.table import Table

MINIMAL = """
import anyio
from mcp import types
from mcp.server import Server
from mcp.server.stdio import stdio_server

TOOL = types.Tool(
    name="get_status",
    description="Answer.",
    input_schema={"type": "object", "properties": {}, "additionalProperties": False},
    output_schema={"type": "object", "properties": {"ok": {"type": "boolean"}}, "required": ["ok"]},
)

async def list_tools(context, params):
    return types.ListToolsResult(tools=[TOOL])

async def call_tool(context, params):
    text = types.TextContent(type="text", text='{"ok": true}')
    return types.CallToolResult(content=[text], structured_content={"ok": True})

async def main():
    server = Server("minimal", on_list_tools=list_tools, on_call_tool=call_tool)
    async with stdio_server() as (read, write):
        await server.run(read, write, server.create_initialization_options())

anyio.run(main)
"""


ANSWER_S = 60.0
"""Time after which a server without an answer is killed, which ends the benchmark."""


class Wire:
    """A minimal client that exchanges JSON lines with a server process."""

    def __init__(self, command: list[str]) -> None:
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        self._count = 0
        self._asked_s = math.inf
        self._over = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()
        client = {"name": "bench", "version": "1"}
        self.ask(
            "initialize",
            {"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": client},
        )
        self._send({"jsonrpc": "2.0", "method": "notifications/initialized"})
        tools = self.ask("tools/list", {})["tools"]
        self._schemas = {tool["name"]: tool["outputSchema"] for tool in tools}

    def _watch(self) -> None:
        """Kill a server that does not answer, which also ends pending waits."""
        while not self._over.wait(1.0):
            if time.monotonic() > self._asked_s + ANSWER_S:
                self._process.kill()

    def _send(self, message: dict[str, Any]) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(message).encode() + b"\n")
        self._process.stdin.flush()

    def ask(self, method: str, params: dict[str, Any]) -> dict[str, Any]:
        """The result of a request; RuntimeError if it is an error or the server has ended."""
        self._count += 1
        self._asked_s = time.monotonic()
        self._send({"jsonrpc": "2.0", "id": self._count, "method": method, "params": params})
        assert self._process.stdout is not None
        for line in self._process.stdout:
            answer = json.loads(line)
            if answer.get("id") == self._count and "method" not in answer:
                if "error" in answer:
                    raise RuntimeError(answer["error"])
                self._asked_s = math.inf
                result: dict[str, Any] = answer["result"]
                return result
        raise RuntimeError(f"the server has left, or did not answer within {ANSWER_S:g} s")

    def call_ms(self, tool: str) -> float:
        """Time of one validated call [ms]."""
        started_s = time.perf_counter()
        result = self.ask("tools/call", {"name": tool, "arguments": {}})
        if result.get("isError"):
            raise RuntimeError(result["content"])
        jsonschema.validate(result["structuredContent"], self._schemas[tool])
        return (time.perf_counter() - started_s) * 1e3

    def close(self) -> None:
        """End the server."""
        self._over.set()
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(20)


def main() -> None:
    """Run both and print one table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--calls", type=int, default=300, metavar="N", help="calls of each server")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        config = Path(scratch) / "roboneuron.toml"
        config.write_text(
            f'[robot]\nname = "fr3"\n[supervisor]\nstate_directory = "{scratch}/state"\n'
        )
        minimal = Wire([sys.executable, "-c", MINIMAL])
        full = Wire(
            [str(Path(sys.executable).with_name("roboneuron")), "serve", "--config", str(config)]
        )
        try:
            kinds = {"minimal server": (minimal, "get_status"), "get_status": (full, "get_status")}
            kinds["list_robots"] = (full, "list_robots")
            for wire, tool in kinds.values():
                for _ in range(20):  # the first call joins ROS
                    wire.call_ms(tool)
            # Interleaved, so that other load on the machine affects all of them equally.
            took_ms: dict[str, list[float]] = {name: [] for name in kinds}
            for _ in range(arguments.calls):
                for name, (wire, tool) in kinds.items():
                    took_ms[name].append(wire.call_ms(tool))
        finally:
            minimal.close()
            full.close()
    table = Table(title="Round trip over stdio, answer validated")
    for head in ("call", "p50 [ms]", "p99 [ms]", "of the minimal server's p50"):
        table.add_column(head)
    base_ms = statistics.median(took_ms["minimal server"])
    for name, times_ms in took_ms.items():
        p50_ms, p99_ms = statistics.median(times_ms), statistics.quantiles(times_ms, n=100)[98]
        table.add_row(name, f"{p50_ms:.2f}", f"{p99_ms:.2f}", f"{p50_ms / base_ms:.2f}")
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
