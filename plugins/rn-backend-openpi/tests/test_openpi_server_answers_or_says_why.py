"""Answers of the server to a plain client, and its errors when the model hangs or fails."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack
from typing import Any

import msgpack
import numpy as np
import pytest
from openpi_clients import (
    INTERFACE,
    KEYS,
    REQUEST,
    SLACK_S,
    ask,
    open_client,
    served,
)
from openpi_format import encode

from rn_backend_openpi.case import Reflex, ReflexOptions, serving
from roboneuron import EE_DELTA


def test_a_plain_client_gets_metadata_and_an_answer_with_times() -> None:
    with served() as url, open_client(url) as connection:
        told = connection.metadata["roboneuron"]["interface"]
        assert (told["profile"], told["action_space"]) == ("libero", EE_DELTA.label)
        assert (told["image_keys"], told["image_resolution"]) == (KEYS, [224, 224])
        first, second = ask(connection), ask(connection)
        assert first["actions"].shape == (4, 7)
        assert first["actions"].dtype == np.float64
        assert first["step_s"] == 0.05
        assert first["policy_timing"]["infer_ms"] >= 0.0
        assert first["server_timing"].keys() == {"infer_ms"}
        assert second["server_timing"].keys() == {"infer_ms", "prev_total_ms"}
        assert ask(connection, {"endpoint": "reset"}) == {"status": "reset successful"}
        arena = {**REQUEST, "endpoint": "infer", "session_id": "abc"}
        np.testing.assert_array_equal(ask(connection, arena)["actions"], first["actions"])


class Stuck(Reflex):
    """Does not answer until it is released."""

    def __init__(self) -> None:
        super().__init__(ReflexOptions(step_s=0.05))
        self.released = threading.Event()

    def predict(self, observation: Any) -> Any:
        self.released.wait(60.0)
        return super().predict(observation)


def test_a_model_that_hangs_is_told_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rn_backend_openpi.conversation.ANSWER_S", 0.3)
    stuck = Stuck()
    with serving(stuck, interface=INTERFACE) as url:
        with open_client(url) as connection:
            start = time.monotonic()
            assert "gave no answer before the deadline" in ask(connection)
            assert time.monotonic() - start < 0.3 + SLACK_S
        stuck.released.set()


def test_a_server_that_ends_waits_for_no_model() -> None:
    stuck = Stuck()
    with ExitStack() as kept:
        with serving(stuck, interface=INTERFACE) as url:
            connection = kept.enter_context(open_client(url))
            connection.send(msgpack.packb(REQUEST, default=encode))
            threading.Timer(0.6, stuck.released.set).start()
            start = time.monotonic()
        # the model answers after the loop has ended, and closing waits for it, not for the client
        assert time.monotonic() - start < 0.6 + SLACK_S


class Broken(Reflex):
    """Fails with an unexpected error."""

    def predict(self, observation: Any) -> Any:
        raise KeyError("/secret/path")


@pytest.mark.parametrize(
    ("wrong", "logged"),
    [
        (Broken(), "/secret/path"),
        (
            Reflex(ReflexOptions(step_s=0.1)),
            "rows every 0.1 s, the profile 'libero' has one every 0.05 s",
        ),
    ],
)
def test_a_fault_of_the_backend_is_logged_and_not_told(
    wrong: Reflex, logged: str, caplog: pytest.LogCaptureFixture
) -> None:
    with serving(wrong, interface=INTERFACE) as url, open_client(url) as connection:
        assert ask(connection) == "PluginError: see the server's log."
    assert logged in caplog.text
