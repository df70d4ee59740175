"""Every wait in benchmarks/ has a bound: a missing event is an error, not an endless benchmark."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"
SCRIPTS = sorted(FOLDER.glob("*.py"))
PARTS_THAT_HANG = {"fault_parts.py", "fault_plugin.py", "switch_plugin.py"}
"""Parts that run in modules and hang on purpose; whoever waits for them has the bound."""
WAITS = {"wait", "result", "join", "communicate", "wait_for_service", "get", "acquire"}
"""Calls that wait forever without an argument."""
PROCESSES = {"run", "call", "check_call", "check_output"}
ONE_ARGUMENT = {"wait_for": 2}
"""Number of positional arguments of calls whose bound comes after the condition."""
POOLS = {"imap", "imap_unordered", "map", "starmap"}
"""Methods of process pools that wait for a dead worker."""
WATCHDOGS = ("threading.Timer(", "daemon=True")
"""A script that reads another process's output line by line must have one of these, because a pipe
has no bound.
"""
BOUNDS = ("deadline", "end_s", "timeout", "duration_s", "fail_after", "cancelled", "_stop")


def faults(text: str) -> Iterator[str]:
    """The waits without a bound in a program."""
    tree = ast.parse(text)
    bounded = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.With | ast.AsyncWith)
        and any("fail_after" in ast.unparse(item.context_expr) for item in node.items)
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and node not in bounded and _has_no_bound(node):
            yield f"line {node.lineno}: {ast.unparse(node)[:100]}"
        if isinstance(node, ast.While) and node not in bounded and _polls(node) and not _ends(node):
            yield f"line {node.lineno}: while {ast.unparse(node.test)[:100]}"
        if (
            isinstance(node, ast.For)
            and ast.unparse(node.iter).endswith(".stdout")
            and not _is_watched(text)
        ):
            yield f"line {node.lineno}: for {ast.unparse(node.iter)[:100]}"


def _has_no_bound(call: ast.Call) -> bool:
    named = {keyword.arg for keyword in call.keywords}
    if named & {"timeout", "timeout_s", "timeout_sec", "read_timeout_seconds"}:
        return False
    if isinstance(call.func, ast.Name):
        return call.func.id == "Client"
    if not isinstance(call.func, ast.Attribute):
        return False
    name, owner = call.func.attr, ast.unparse(call.func.value)
    if owner == "subprocess":
        return name in PROCESSES
    # of a ROS client; agents' calls are bounded by `Client(read_timeout_seconds=...)`
    if name == "call":
        return not owner.endswith(("portal", "agent"))
    if name in POOLS:
        return "pool" in owner
    return (name in WAITS and not call.args) or len(call.args) < ONE_ARGUMENT.get(name, 0)


def _polls(loop: ast.While) -> bool:
    return any(isinstance(node, ast.Attribute) and node.attr == "sleep" for node in ast.walk(loop))


def _ends(loop: ast.While) -> bool:
    tests = [loop.test, *(node.test for node in ast.walk(loop) if isinstance(node, ast.If))]
    return any(word in ast.unparse(test) for test in tests for word in BOUNDS)


def _is_watched(text: str) -> bool:
    return any(word in text for word in WATCHDOGS)


@pytest.mark.parametrize(
    "path", [p for p in SCRIPTS if p.name not in PARTS_THAT_HANG], ids=lambda path: path.name
)
def test_no_wait_of_a_benchmark_is_unbounded(path: Path) -> None:
    assert list(faults(path.read_text(encoding="utf-8"))) == []


@pytest.mark.parametrize(
    "text",
    [
        "process.wait()",
        "future.result()",
        "thread.join()",
        "process.communicate()",
        "client.wait_for_service()",
        "client.call(request)",
        "condition.wait_for(fact)",
        "subprocess.run(['true'], check=True)",
        "async def f():\n    async with Client(server) as client: pass",
        "while peers():\n    time.sleep(0.02)",
        "pool.imap(run, jobs)",
        "for line in process.stdout:\n    print(line)",
    ],
)
def test_an_unbounded_wait_is_found(text: str) -> None:
    assert len(list(faults(text))) == 1


@pytest.mark.parametrize(
    "text",
    [
        "process.wait(10)",
        "', '.join(names)",
        "client.call(request, timeout_sec=10)",
        "condition.wait_for(fact, 3.0)",
        "subprocess.run(['true'], timeout=5)",
        "Client(server, read_timeout_seconds=60)",
        "pool.apply_async(run, jobs).get(30)",
        "threading.Timer(30, process.kill).start()\nfor line in process.stdout:\n    print(line)",
        "while time.monotonic() < end_s:\n    time.sleep(0.02)",
        "async def f():\n    with anyio.fail_after(3):\n        while peers():\n            await "
        "anyio.sleep(0.02)",
    ],
)
def test_a_bounded_wait_passes(text: str) -> None:
    assert list(faults(text)) == []
