from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path

import pytest

from rn_runtime_sglang.case import token_request
from rn_testing.waiting import holds_within
from roboneuron.errors import CheckpointError, NotReadyError


def test_requests_go_to_the_ready_server_with_the_least_load(launch, connect):
    busy, idle = launch(running=3.0, queued=1.0), launch(running=1.0)
    runtime = connect(busy, idle)
    sent = len(idle.seen.generated)
    for seed in range(3):
        runtime.run(token_request(seed=seed))
    assert len(idle.seen.generated) == sent + 3
    busy.behaviour.running = busy.behaviour.queued = 0.0
    idle.behaviour.running = 5.0
    assert holds_within(lambda: runtime.run(token_request()).metrics["served.running"] == 5.0)
    sent = len(busy.seen.generated)
    runtime.run(token_request())
    assert len(busy.seen.generated) == sent + 1


def test_a_dying_server_costs_no_action_when_another_is_ready(launch, connect):
    first, second = launch(), launch(running=1.0)
    runtime = connect(first, second)
    assert runtime.run(token_request()).metrics["served.servers_ready"] == 2.0
    first.stop()
    for seed in range(5):
        assert runtime.run(token_request(seed=seed)).tokens.size == 7
    assert runtime.run(token_request()).metrics["served.servers_ready"] == 1.0


def test_a_hanging_server_costs_one_action(launch, connect):
    first, second = launch(), launch(running=1.0)
    runtime = connect(first, second, timeout_s=0.3, poll_s=30.0)
    first.behaviour.fault = "hang"
    first.behaviour.ready = False
    with pytest.raises(NotReadyError, match="did not answer in time"):
        runtime.run(token_request())
    for seed in range(5):
        runtime.run(token_request(seed=seed))


def test_a_malformed_reply_is_made_good_by_another_server(launch, connect):
    first, second = launch(), launch(running=1.0)
    runtime = connect(first, second)
    first.behaviour.fault = "malformed"
    assert runtime.run(token_request()).metrics["served.retried"] == 1.0


def test_one_url_with_another_model_is_an_error_at_the_start(launch, connect):
    with pytest.raises(CheckpointError, match="/models/other"):
        connect(launch(), launch(served_name="other@0123", model_path="/models/other"))


@pytest.mark.exhaustive
def test_a_server_that_is_down_at_the_start_joins_later_but_not_with_another_model(launch, connect):
    first, second = launch(running=4.0), launch()
    second.stop()
    runtime = connect(first, second)
    assert runtime.run(token_request()).metrics["served.servers_ready"] == 1.0
    second.behaviour.served_name = "other@0123"
    second.start()
    assert not holds_within(
        lambda: runtime.run(token_request()).metrics["served.servers_ready"] == 2.0, timeout_s=0.3
    )
    assert second.seen.generated == []
    second.behaviour.served_name = first.behaviour.served_name
    assert holds_within(lambda: runtime.run(token_request()).metrics["served.servers_ready"] == 2.0)
    runtime.run(token_request())
    assert second.seen.generated


def test_a_server_that_is_replaced_by_another_model_gets_no_more_requests(launch, connect):
    server = launch()
    runtime = connect(server)
    server.stop()
    server.behaviour.served_name = "other@0123"
    with pytest.raises(NotReadyError):
        runtime.run(token_request())
    server.start()
    assert holds_within(lambda: _refused(runtime))
    sent = len(server.seen.generated)
    with pytest.raises(NotReadyError, match="serves 'other@0123'"):
        runtime.run(token_request())
    assert len(server.seen.generated) == sent


def _refused(runtime) -> bool:
    try:
        runtime.run(token_request())
    except NotReadyError as error:
        return "No server may be used" in str(error)
    return False


def test_requests_go_out_of_a_process_with_thousands_of_open_files(launch, connect):
    with ExitStack() as files:
        for _ in range(1100):
            files.enter_context(Path(os.devnull).open())
        server = launch()
        runtime = connect(server)
        for _ in range(2):  # the second one checks that its connection still exists
            assert len(runtime.run(token_request()).tokens) == 7
