"""An agent made of OpenAI's client library and a scripted chat server on loopback calls tools.

The library has its own environment (`make .venv-openai`); without it the test is skipped.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[4]
LIBRARY = next(iter(ROOT.glob(".venv-openai/lib/python*/site-packages")), None)
pytestmark = pytest.mark.skipif(LIBRARY is None, reason="run `make .venv-openai`")

AGENT = """
import asyncio, json, sys
sys.path.append(sys.argv[1])
from rn_eval.agents.client import Briefing, ToolAnswer
from rn_eval.agents.subjects.chat import act
from roboneuron import RoboNeuronError

class Tool:
    name, description, input_schema = "look", "Look.", {"type": "object", "properties": {}}

class Tools:
    calls = []
    async def listed(self):
        return [Tool()]
    async def call_with(self, tool, arguments):
        self.calls.append([tool, arguments])
        if tool == "look":
            return ToolAnswer(ok=True, data={"seen": "red"}, images=(b"\\x89PNG...",))
        return ToolAnswer(ok=False, code="refused", text="No.")

try:
    words = asyncio.run(act(Tools(), Briefing(instruction="Which colour?", seed=3)))
except RoboNeuronError as error:
    words = type(error).__name__
print(json.dumps([words, Tools.calls]))
"""


def calling(*calls: tuple[str, str]) -> dict:
    made = [
        {"id": f"c{n}", "type": "function", "function": {"name": name, "arguments": arguments}}
        for n, (name, arguments) in enumerate(calls)
    ]
    return {"role": "assistant", "content": None, "tool_calls": made}


class ChatServer:
    """Answers each request with the next message of its script, and then always the last one.

    Attributes:
        requests: bodies of the requests.
    """

    def __init__(self, script: list[dict], status: int = 200) -> None:
        self.requests: list[dict] = []
        served = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                size = int(self.headers["Content-Length"])
                served.requests.append(json.loads(self.rfile.read(size)))
                message = script[min(len(served.requests), len(script)) - 1]
                choice = {"index": 0, "message": message, "finish_reason": "stop"}
                answer = {"id": "x", "object": "chat.completion", "created": 1, "model": "m"}
                body = json.dumps({**answer, "choices": [choice]}).encode()
                self.send_response(status)
                self.send_header("Content-Type", "application/json")
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *arguments: object) -> None:
                pass

        self._server = HTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_port}/v1"
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.02,), daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(5)


@pytest.fixture
def serve() -> Iterator[object]:
    servers: list[ChatServer] = []

    def make(script: list[dict], status: int = 200) -> ChatServer:
        servers.append(ChatServer(script, status))
        return servers[-1]

    yield make
    for server in servers:
        server.close()


def act(url: str, **more: str) -> tuple[str, list]:
    environment = {
        "PATH": "/usr/bin",
        "OPENAI_BASE_URL": url,
        "OPENAI_API_KEY": "none",
        "AGENT_EVAL_MODEL": "m",
        **more,
    }
    done = subprocess.run(
        [sys.executable, "-c", AGENT, str(LIBRARY)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    words, calls = json.loads(done.stdout)
    return words, calls


def test_a_model_calls_tools_and_ends_with_its_words(serve):
    script = [
        calling(("look", '{"far": true}')),
        calling(("jump", "{}"), ("look", "no json"), ("look", "[1]")),
        {"role": "assistant", "content": "ANSWER: red\nCLAIM: done"},
    ]
    server = serve(script)
    words, calls = act(server.url)
    assert words == "ANSWER: red\nCLAIM: done"
    assert calls == [["look", {"far": True}], ["jump", {}]]
    first, second, third = server.requests
    assert first["tools"][0]["function"]["name"] == "look"
    assert (first["model"], first["seed"]) == ("m", 3)
    assert first["messages"][-1] == {"role": "user", "content": "Which colour?"}
    told, pictured = second["messages"][-2:]
    assert (told["role"], told["content"]) == ("tool", '{"seen": "red"}')
    assert pictured["content"][1]["image_url"]["url"].startswith("data:image/png;base64,")
    answers = [m["content"] for m in third["messages"] if m["role"] == "tool"][1:]
    assert answers[0] == "Error: No."
    for refused in answers[1:]:
        assert refused.startswith("Error: ")
        assert "JSON" in refused


def test_a_model_that_never_ends_is_ended(serve):
    server = serve([calling(("jump", "{}"))])
    words, calls = act(server.url)
    assert words.startswith("CLAIM: not done")
    assert len(calls) == len(server.requests) == 60


def test_a_failing_chat_server_and_a_missing_model_are_named(serve):
    assert act(serve([{"role": "assistant", "content": "x"}], 400).url)[0] == "NotReadyError"
    assert act("http://127.0.0.1:9/v1", AGENT_EVAL_MODEL="")[0] == "ConfigurationError"
