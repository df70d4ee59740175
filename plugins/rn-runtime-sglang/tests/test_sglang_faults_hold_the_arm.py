from __future__ import annotations

import socket
import threading
import time

import pytest

from rn_runtime_sglang.case import token_request
from rn_testing.waiting import holds_within
from roboneuron.errors import NotReadyError, RoboNeuronError, UnsafeError

AT_ONCE_S = 10.0
"""Long enough for a busy machine, and much shorter than the minute of the skipped wait."""


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("malformed", "is no valid JSON"),
        ("short", "expected 7 ids below 32064"),
        ("range", "expected 7 ids below 32064"),
        ("other", "answers the request 'another'"),
        ("error", "answered 500: Internal Server Error"),
        ("hang up", "hung up"),
        ("too long", "over 4194304 bytes"),
    ],
)
def test_a_wrong_reply_is_never_an_action(launch, connect, fault, words):
    server = launch()
    runtime = connect(server)
    server.behaviour.fault = fault
    with pytest.raises(NotReadyError, match=words):
        runtime.run(token_request())
    server.behaviour.fault = ""
    reply = runtime.run(token_request())
    assert reply.metrics["served.failed"] == 2.0
    assert reply.metrics["served.retried"] == 1.0


def test_logits_that_are_not_finite_are_unsafe(launch, connect):
    server = launch()
    runtime = connect(server)
    server.behaviour.fault = "nan"
    with pytest.raises(UnsafeError, match="NaN or infinite"):
        runtime.run(token_request())


def test_a_late_answer_is_dropped_aborted_and_counted(launch, connect):
    server = launch()
    runtime = connect(server, timeout_s=0.2)
    server.behaviour.delay_s = 60.0
    started_s = time.monotonic()
    with pytest.raises(NotReadyError, match="did not answer in time"):
        runtime.run(token_request())
    assert time.monotonic() - started_s < AT_ONCE_S
    late = server.seen.generated[-1]
    assert holds_within(lambda: late in server.seen.aborted)
    server.behaviour.delay_s = 0.0
    reply = runtime.run(token_request())
    assert reply.metrics["served.late"] == 1.0
    assert reply.metrics["served.failed"] == 0.0


def test_the_deadline_of_the_request_counts_when_it_is_shorter(launch, connect):
    server = launch()
    runtime = connect(server, timeout_s=60.0)
    server.behaviour.delay_s = 60.0
    started_s = time.monotonic()
    with pytest.raises(NotReadyError, match="did not answer in time"):
        runtime.run(token_request(deadline_s=started_s + 0.2))
    assert time.monotonic() - started_s < AT_ONCE_S
    with pytest.raises(NotReadyError, match="deadline had passed"):
        runtime.run(token_request(deadline_s=started_s))


def test_an_answer_that_trickles_in_is_late_too(launch, connect):
    server = launch()
    runtime = connect(server, timeout_s=0.3)
    server.behaviour.fault = "trickle"
    started_s = time.monotonic()
    with pytest.raises(NotReadyError, match="did not answer in time"):
        runtime.run(token_request())
    assert time.monotonic() - started_s < AT_ONCE_S


def test_a_half_open_connection_costs_one_timeout(launch, connect):
    server = launch()
    runtime = connect(server, timeout_s=0.3)
    server.behaviour.fault = "hang"
    started_s = time.monotonic()
    with pytest.raises(NotReadyError, match="did not answer in time"):
        runtime.run(token_request())
    assert time.monotonic() - started_s < AT_ONCE_S


def test_a_listener_that_never_answers_is_not_ready(model):
    from rn_runtime_sglang.config import SglangRuntimeConfig
    from rn_runtime_sglang.runtime import SglangRuntime

    with socket.create_server(("127.0.0.1", 0)) as listener:
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        runtime = SglangRuntime(SglangRuntimeConfig(urls=(url,), start_timeout_s=1.3))
        with pytest.raises(NotReadyError, match="did not answer /ready in time"):
            runtime.load(model)


def test_a_server_killed_during_a_request_ends_it_at_once_and_its_return_is_noticed(
    launch, connect
):
    server = launch()
    runtime = connect(server, timeout_s=60.0)
    server.behaviour.delay_s = 60.0
    error = _run_until_sent(runtime, server)
    started_s = time.monotonic()
    server.stop()
    assert isinstance(error(), NotReadyError)
    assert time.monotonic() - started_s < AT_ONCE_S
    server.behaviour.delay_s = 0.0
    server.start()
    assert runtime.run(token_request()).tokens.size == 7


def test_a_killed_stand_in_answers_nobody(launch, connect, monkeypatch):
    server = launch()
    runtime = connect(server, timeout_s=60.0)
    server.behaviour.delay_s = 60.0
    error = _run_until_sent(runtime, server)
    hang_up = type(server._http).hang_up
    # On a busy machine the waiting handler continues before the connections are closed.
    monkeypatch.setattr(
        type(server._http), "hang_up", lambda http: (time.sleep(0.3), hang_up(http))
    )
    server.stop()
    assert isinstance(error(), NotReadyError)


def test_abort_ends_a_request_at_once_here_and_there(launch, connect):
    server = launch()
    runtime = connect(server, timeout_s=60.0)
    server.behaviour.delay_s = 60.0
    error = _run_until_sent(runtime, server)
    started_s = time.monotonic()
    runtime.abort()
    assert "abort was called" in str(error())
    assert time.monotonic() - started_s < AT_ONCE_S
    assert holds_within(lambda: server.seen.generated[-1] in server.seen.aborted)
    server.behaviour.delay_s = 0.0
    assert runtime.run(token_request()).metrics["served.aborted"] == 1.0


def test_close_ends_a_request_at_once(launch, connect):
    server = launch()
    runtime = connect(server, timeout_s=60.0)
    server.behaviour.delay_s = 60.0
    error = _run_until_sent(runtime, server)
    runtime.close()
    assert isinstance(error(), RoboNeuronError)


def _run_until_sent(runtime, server):
    """Start a request on a thread and wait until it has reached the server; returns a function that
    returns its error.
    """
    errors: list[BaseException] = []
    before = len(server.seen.generated)

    def work() -> None:
        try:
            runtime.run(token_request())
        except RoboNeuronError as error:
            errors.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    assert holds_within(lambda: len(server.seen.generated) > before)

    def join() -> BaseException:
        thread.join(5.0)
        assert not thread.is_alive()
        return errors[0]

    return join
