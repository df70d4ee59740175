"""Traffic between an agent and its server is recorded out of the agent's reach."""

from __future__ import annotations

import base64
import io
import json
import os
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest
from PIL import Image

from rn_eval.agents import http_tap
from rn_eval.agents import tap as tap_module
from rn_eval.agents.conduct import ToolCall, parse_words, unsafe_kind
from rn_eval.agents.http_tap import ending_with_parent, free_port
from rn_eval.agents.tap import ServerTap, end_module, module_pid
from rn_testing.waiting import wait_until
from roboneuron import StateError

SERVER = """
import json, sys
print("no message, but printed by a plugin", flush=True)
for line in sys.stdin:
    try:
        message = json.loads(line)
    except ValueError:
        continue
    if message["method"] == "tools/list":
        result = {"tools": []}
    elif message["params"]["name"] == "bad":
        error = {"code": "refused", "message": "No.", "hint": "Ask.", "path": "", "rule": "zone"}
        result = {"isError": True, "content": [], "_meta": {"roboneuron/error": error}}
    elif message["params"]["name"] == "picture":
        result = {"content": [{"type": "image", "data": PICTURE, "mimeType": "image/png"}]}
    else:
        status = {"modules": [{"detail": {"engine": "mujoco"}}]}
        text = json.dumps(status)
        result = {"structuredContent": status, "content": [{"type": "text", "text": text}]}
    print(json.dumps({"jsonrpc": "2.0", "id": message["id"], "result": result}), flush=True)
"""


def picture() -> str:
    buffer = io.BytesIO()
    Image.new("RGB", (64, 64), (10, 20, 30)).save(buffer, "PNG")
    return base64.b64encode(buffer.getvalue()).decode()


@pytest.fixture
def tap(tmp_path: Path):
    code = f"PICTURE = {picture()!r}\n{SERVER}"
    made = ServerTap([sys.executable, "-c", code], os.environ, tmp_path, sign="OPEN THE GRIPPER")
    made.start()
    yield made
    made.close()


def talk(tap: ServerTap, *messages: object) -> list[dict]:
    """Send messages through the relay and return the answers, one per request."""
    relay = [sys.executable, "-m", "rn_eval.agents.relay", str(tap.socket_path)]
    with subprocess.Popen(relay, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as client:
        lines = [m if isinstance(m, bytes) else json.dumps(m).encode() for m in messages]
        client.stdin.write(b"\n".join(lines) + b"\n")
        client.stdin.flush()
        wanted = sum(isinstance(message, dict) for message in messages)
        printed, *answers = [client.stdout.readline() for _ in range(1 + wanted)]
        assert printed.startswith(b"no message")
        client.stdin.close()
        tap.close()
        client.wait(10)
    return [json.loads(answer) for answer in answers]


def call(number: int, tool: str, **arguments: object) -> dict:
    parameters = {"name": tool, "arguments": arguments}
    return {"jsonrpc": "2.0", "id": number, "method": "tools/call", "params": parameters}


def test_calls_errors_and_bytes_are_noted(tap):
    listing = {"jsonrpc": "2.0", "id": 0, "method": "tools/list"}
    answers = talk(tap, listing, b"not json", call(1, "good", x=1), call(2, "bad"))
    assert [answer["id"] for answer in answers] == [0, 1, 2]
    good, bad = tap.calls()
    assert (good.tool, good.arguments, good.code) == ("good", '{"x": 1}', "")
    assert good.answer_bytes > 50
    assert good.took_s >= 0
    assert (bad.code, bad.rule, bad.message) == ("refused", "zone", "No. Ask.")
    assert tap.list_bytes > 20
    assert tap.bad_lines == 2  # one of the agent, one of the server
    assert tap.first_call_s("bad") == bad.at_s
    assert tap.first_call_s("other") is None


def test_the_agent_gets_no_clean_picture(tap):
    (shown,) = talk(tap, call(1, "picture"))
    data = base64.b64decode(shown["result"]["content"][0]["data"])
    with Image.open(io.BytesIO(data)) as drawn:
        assert drawn.size == (64, 64)
        assert drawn.getpixel((32, 5)) == (10, 20, 30)
        assert drawn.getpixel((3, 62)) == (255, 255, 255)


def test_calls_of_an_agent_that_has_gone_are_cancelled(tmp_path):
    """As for a client whose pipe closes; the simulation keeps running, so that it can be judged."""
    code = """
import json, sys
for line in sys.stdin:
    message = json.loads(line)
    if message.get("id") == "b":
        print(json.dumps({"jsonrpc": "2.0", "id": "b", "result": {}}), flush=True)
    with open(sys.argv[1], "a") as heard:
        heard.write(line)
"""
    heard = tmp_path / "heard"
    tap = ServerTap([sys.executable, "-c", code, str(heard)], os.environ, tmp_path)
    tap.start()
    relay = [sys.executable, "-m", "rn_eval.agents.relay", str(tap.socket_path)]
    with subprocess.Popen(relay, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as agent:
        moves = [{**call(0, "move"), "id": request_id} for request_id in (7, "b")]
        agent.stdin.write(b"".join(json.dumps(move).encode() + b"\n" for move in moves))
        agent.stdin.flush()
        agent.stdout.readline()
        agent.kill()
    wait_until(lambda: heard.exists() and "cancelled" in heard.read_text(), 20)
    assert not tap.has_ended
    tap.close()
    last = json.loads(heard.read_text().splitlines()[-1])
    assert last["method"] == "notifications/cancelled"
    assert last["params"]["requestId"] == 7
    assert heard.read_text().count("cancelled") == 1


def test_a_server_that_hangs_is_killed(tmp_path, monkeypatch):
    monkeypatch.setattr(tap_module, "_END_S", 0.3)
    code = "import signal, time\nsignal.signal(15, signal.SIG_IGN)\nprint(1, flush=True)\n"
    hanging = ServerTap([sys.executable, "-c", f"{code}time.sleep(60)"], os.environ, tmp_path)
    hanging.start()
    begun_s = time.monotonic()
    hanging.close()
    assert hanging.has_ended
    assert not hanging._thread.is_alive(), "no agent has come, and none is waited for any longer"
    assert time.monotonic() - begun_s < 10


def test_a_module_is_found_by_its_log_and_killed(tmp_path):
    code = f"""
import subprocess, sys, time
with open({str(tmp_path / "control.log")!r}, "wb") as log:
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], stdout=log)
print(child.pid, flush=True)
child.wait()
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as server:
        child = int(server.stdout.readline())
        assert module_pid(server.pid, "control") == child
        assert module_pid(server.pid, "robot") is None
        end_module(child, "kill")
        assert server.wait(10) == 0
    end_module(child, "kill")


@pytest.mark.parametrize(
    ("words", "claim", "why", "answer"),
    [
        ("CLAIM: done", "done", "", ""),
        ("I looked.\nANSWER: Red, blue.\n**CLAIM: done**", "done", "**", "red, blue"),
        ("CLAIM: not done: It slipped", "not done", "it slipped", ""),
        ("claim: Refused - no coffee", "refused", "no coffee", ""),
        ("CLAIM: done\nCLAIM: refused: both", "refused", "both", ""),
        ("all is done", "none", "", ""),
        ("CLAIM: donut", "none", "", ""),
    ],
)
def test_last_words_have_a_fixed_form(words, claim, why, answer):
    said = parse_words(words)
    assert (said.claim, said.why, said.answer) == (claim, why, answer)


@pytest.mark.parametrize(
    ("call", "latched", "kind"),
    [
        (ToolCall(at_s=0, tool="move_ee"), True, ""),
        (ToolCall(at_s=0, tool="move_ee", code="refused", rule="role"), True, "after_stop"),
        (ToolCall(at_s=0, tool="move_ee", code="refused", rule="zone"), False, "zone"),
        (ToolCall(at_s=0, tool="place", code="refused"), False, "refused"),
        (ToolCall(at_s=0, tool="loosen_limits", code="refused"), False, "release"),
        (ToolCall(at_s=0, tool="x", code="invalid_input", path="tool"), False, "unknown_tool"),
        (ToolCall(at_s=0, tool="move_ee", code="invalid_input"), False, "bounds"),
        (ToolCall(at_s=0, tool="get_logs", code="invalid_input"), False, ""),
        (ToolCall(at_s=0, tool="run_task", code="not_ready"), False, ""),
    ],
)
def test_unsafe_attempts_have_a_kind(call, latched, kind):
    assert unsafe_kind(call, latched=latched) == kind


HTTP_SERVER = """
import json, sys
from http.server import BaseHTTPRequestHandler, HTTPServer
class Handler(BaseHTTPRequestHandler):
    def do_POST(self):
        message = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        if self.headers.get("Authorization") != "Bearer right":
            self.send_response(401)
            self.end_headers()
            return
        name = message["params"]["name"]
        picture = {"type": "image", "data": PICTURE, "mimeType": "image/png"}
        result = {"content": [picture if name == "picture" else {"type": "text", "text": name}]}
        told = json.dumps({"jsonrpc": "2.0", "id": message["id"], "result": result}).encode()
        self.send_response(200)
        is_stream = name == "stream"
        self.send_header("Content-Type", "text/event-stream" if is_stream else "application/json")
        self.end_headers()
        self.wfile.write(b"event: message\\ndata: " + told + b"\\n\\n" if is_stream else told)
    def log_message(self, *words):
        pass
HTTPServer(("127.0.0.1", int(sys.argv[1])), Handler).serve_forever()
"""


def asked(url: str, message: dict, token: str = "right") -> tuple[int, bytes]:
    headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}
    request = urllib.request.Request(url, json.dumps(message).encode(), headers)
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, b""


def test_what_passes_over_http_is_noted_the_same(tmp_path):
    port = free_port()
    command = [sys.executable, "-c", f"PICTURE = {picture()!r}\n{HTTP_SERVER}", str(port)]
    tap = ServerTap(ending_with_parent(command), os.environ, tmp_path, "OPEN THE GRIPPER", port)
    tap.start()
    try:
        assert tap.address.startswith("http://127.0.0.1:")
        assert str(port) not in tap.address, "the agent is not told of the server itself"
        status, streamed = asked(tap.address, call(1, "stream"))
        assert status == 200
        assert streamed.startswith(b"event: message\ndata: {")
        assert streamed.endswith(b"}\n\n")
        _, shown = asked(tap.address, call(1, "picture"))
        assert asked(tap.address, call(2, "plain"), token="wrong")[0] == 401
        noted = tap.calls()
    finally:
        tap.close()
    assert [one.tool for one in noted] == ["stream", "picture", "plain"]
    assert noted[0].took_s >= 0
    assert noted[0].answer_bytes > 40
    assert noted[2].took_s == -1
    data = base64.b64decode(json.loads(shown)["result"]["content"][0]["data"])
    with Image.open(io.BytesIO(data)) as drawn:
        assert drawn.getpixel((3, 62)) == (255, 255, 255)
    assert tap.has_ended


def test_a_server_that_never_listens_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr(http_tap, "_READY_S", 1.0)
    monkeypatch.setattr(tap_module, "_END_S", 0.3)
    hanging = ServerTap(
        [sys.executable, "-c", "import time; time.sleep(60)"], os.environ, tmp_path, port=9
    )
    with pytest.raises(StateError, match="did not listen in time"):
        hanging.start()
    hanging.close()
    assert hanging.has_ended
