"""A monitor behind an HTTP endpoint: what is sent, and what a bad endpoint leads to."""

from __future__ import annotations

import base64
import io
import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from monitors import BOUND_S, observation, settled
from PIL import Image

from rn_standard.tasks.guarded import GuardedMonitor
from rn_standard.tasks.http_judge import HttpJudge, HttpJudgeOptions
from rn_standard.tasks.monitor import Score
from roboneuron import ConfigurationError

Answer = Callable[[dict[str, object]], tuple[int, bytes]]


@contextmanager
def endpoint(answer: Answer, heard: list[str] | None = None) -> Iterator[str]:
    """A scripted server; yields its address."""

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            question = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            if heard is not None:
                heard.append(self.headers.get("Authorization", ""))
            status, body = answer(question)
            try:
                self.send_response(status)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)
            except OSError:
                pass  # the caller has given up

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/judge?suite=cubes"
    finally:
        server.shutdown()
        thread.join(BOUND_S)
        server.server_close()


def says(**facts: object) -> Answer:
    return lambda question: (200, json.dumps(facts).encode())


def judged(answer: Answer, timeout_s: float = 4.0) -> Score:
    with endpoint(answer) as url:
        return HttpJudge(HttpJudgeOptions(url=url, timeout_s=timeout_s)).score(observation())


def test_the_endpoint_sees_what_the_monitor_sees(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JUDGE_TOKEN", "secret")
    questions: list[dict[str, object]] = []
    heard: list[str] = []

    def answer(question: dict[str, object]) -> tuple[int, bytes]:
        questions.append(question)
        return says(success=0.93, progress=1, failure=0.0, reason="The cube is up.")(question)

    with endpoint(answer, heard) as url:
        judge = HttpJudge(HttpJudgeOptions(url=url, token_env="JUDGE_TOKEN"))
        judge.reset(observation(1, 1.0))
        score = judge.score(observation(200, 2.0))
    assert score == Score(value=0.93, reason="The cube is up", progress=1.0, failure=0.0)
    (question,) = questions
    assert heard == ["Bearer secret"]
    assert question["instruction"] == "pick it up"
    assert question["gripper_open"] == 1.0
    assert question["tcp_position_m"] == [0.4, 0.0, 0.2]
    for name, stamp_ns, content in (("images", 2_000_000_000, 200), ("before", 1_000_000_000, 1)):
        (image,) = question[name]  # type: ignore[misc]
        assert (image["role"], image["stamp_ns"]) == ("primary", stamp_ns)
        picture = Image.open(io.BytesIO(base64.b64decode(image["jpeg"])))
        assert picture.size == (8, 8)
        assert picture.getpixel((4, 4))[0] == pytest.approx(content, abs=2)  # type: ignore[index]


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (says(success=float("nan")), "NaN is no number"),
        (says(success=7), "success is 7"),
        (says(success=True), "success is True"),
        (says(success=0.5, progress="half"), "progress is 'half'"),
        (says(progress=0.5), "'success' is missing"),
        (lambda question: (200, b"[0.9]"), "is no table"),
        (lambda question: (200, b"it is done"), "no valid JSON"),
        (lambda question: (200, b" " * 100_000), "65537 bytes"),
        (lambda question: (503, b"busy"), "status 503"),
        (lambda question: (307, b""), "status 307"),
    ],
)
def test_a_bad_answer_gives_no_value(answer: Answer, text: str) -> None:
    score = judged(answer)
    assert score.value is None
    assert text in score.reason


def test_what_the_endpoint_cannot_tell_has_no_value() -> None:
    score = judged(says(success=None, reason="the hand hides it"))
    assert score == Score(value=None, reason="the hand hides it")


def test_no_endpoint_gives_no_value() -> None:
    with endpoint(says(success=1.0)) as url:
        gone = url
    score = HttpJudge(HttpJudgeOptions(url=gone)).score(observation())
    assert score.value is None
    assert "ConnectionRefusedError" in score.reason


def test_without_a_picture_nothing_is_asked() -> None:
    def never(question: dict[str, object]) -> tuple[int, bytes]:
        pytest.fail("it was asked")

    with endpoint(never) as url:
        blind = replace(observation(), frames={})
        assert HttpJudge(HttpJudgeOptions(url=url)).score(blind).value is None


def test_a_slow_endpoint_makes_the_monitor_absent() -> None:
    entered, go_on = threading.Event(), threading.Event()

    def slow(question: dict[str, object]) -> tuple[int, bytes]:
        entered.set()
        go_on.wait(BOUND_S)
        return says(success=1.0)(question)

    now_s = [0.0]
    with endpoint(slow) as url:
        guard = GuardedMonitor(
            lambda: HttpJudge(HttpJudgeOptions(url=url, timeout_s=4.5)), 2.0, lambda: now_s[0]
        )
        guard.offer(observation(), 0.0)
        assert entered.wait(BOUND_S)
        now_s[0] = 2.5
        assert "has not answered for 2.5 s (its limit is 2 s)" in guard.answer().reason
        go_on.set()
        assert settled(guard).score is None
        guard.close()


def test_a_silent_endpoint_is_given_up() -> None:
    go_on = threading.Event()

    def silent(question: dict[str, object]) -> tuple[int, bytes]:
        go_on.wait(BOUND_S)
        return 200, b"{}"

    with endpoint(silent) as url:
        score = HttpJudge(HttpJudgeOptions(url=url, timeout_s=0.2)).score(observation())
        go_on.set()
    assert score.value is None
    assert "TimeoutError" in score.reason


def test_it_needs_an_address() -> None:
    with pytest.raises(ConfigurationError, match="no address"):
        HttpJudge(None)
