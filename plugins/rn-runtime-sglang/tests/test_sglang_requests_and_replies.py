from __future__ import annotations

import base64
import io
import logging
import time
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from rn_runtime_sglang.case import token_request, write_checkpoint
from rn_runtime_sglang.served.fingerprint import served_name
from rn_runtime_sglang.standin.replies import expected_tokens
from rn_runtime_sglang.wire import parse_metrics
from roboneuron.errors import (
    CheckpointError,
    ConfigurationError,
    InvalidInputError,
    MissingDependencyError,
    NotReadyError,
)


@pytest.mark.parametrize("image_format", ["png", "bmp"])
def test_a_request_carries_ids_and_the_image_without_loss(launch, connect, image_format):
    server = launch()
    request = token_request(seed=3)
    reply = connect(server, image_format=image_format).run(request)
    raw = base64.b64decode(server.seen.body["image_data"])
    assert server.seen.body["input_ids"] == request.prompt.ids.tolist()
    assert server.seen.body["sampling_params"] == {
        "temperature": 0,
        "max_new_tokens": 7,
        "ignore_eos": True,
    }
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(raw))), request.prompt.images[0])
    assert reply.tokens.tolist() == expected_tokens(request.prompt.ids.tolist(), raw, 7)
    assert reply.tokens.dtype == np.int64


def test_a_reply_tells_size_times_and_the_load_of_the_servers(launch, connect):
    server = launch(running=2.0, queued=3.0)
    runtime = connect(server)
    metrics = runtime.run(token_request()).metrics
    assert metrics["served.request_bytes"] == pytest.approx(server.seen.body_bytes, abs=50)
    assert metrics["served.running"] == 2.0
    assert metrics["served.queued"] == 3.0
    assert metrics["served.token_usage"] == 0.07
    assert metrics["served.servers_ready"] == 1.0
    assert metrics["served.prompt_tokens"] == 9 + 256
    assert metrics["served.late"] == 0.0
    assert 0.0 < metrics["served.model_ms"] < metrics["model_ms"]
    assert metrics["served.encode_ms"] + metrics["served.round_trip_ms"] == pytest.approx(
        metrics["model_ms"]
    )


def test_a_server_without_metrics_is_used_all_the_same(launch, connect):
    metrics = connect(launch(running=None)).run(token_request()).metrics
    assert "served.running" not in metrics


def test_requests_share_one_connection(launch, connect):
    server = launch()
    runtime = connect(server)
    before = _connections(server.port)
    for seed in range(5):
        runtime.run(token_request(seed=seed))
    assert _connections(server.port) == before


def _connections(port: int) -> int:
    with open("/proc/net/tcp", encoding="ascii") as table:
        rows = [line.split() for line in table.readlines()[1:]]
    return sum(row[2].endswith(f":{port:04X}") and row[3] == "01" for row in rows)


def test_a_connection_that_the_server_closed_meanwhile_costs_nothing(launch, connect):
    server = launch()
    runtime = connect(server)
    server.stop()
    server.start()
    reply = runtime.run(token_request())
    assert reply.metrics["served.failed"] == 0.0


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        (replace(token_request(), with_logits=True), "Logits"),
        (token_request(count=65), "at most 64"),
        (replace(token_request(), max_new_tokens=8), "1 to 7"),
        (
            replace(token_request(), prompt=replace(token_request().prompt, images=())),
            "exactly one image",
        ),
    ],
)
def test_requests_that_cannot_be_served_are_refused_before_they_are_sent(
    launch, connect, request_, words
):
    server = launch()
    runtime = connect(server)
    sent = len(server.seen.generated)
    with pytest.raises(InvalidInputError, match=words):
        runtime.run(request_)
    assert len(server.seen.generated) == sent


def test_what_the_server_does_not_take_is_an_invalid_input_with_its_words(launch, connect):
    request = token_request()
    wrong = replace(request, prompt=replace(request.prompt, ids=request.prompt.ids[:-1]))
    with pytest.raises(InvalidInputError, match=r"expected \[1 \.\.\. 29871\]"):
        connect(launch()).run(wrong)


def test_a_server_with_another_checkpoint_of_the_same_name_is_refused(launch, connect, tmp_path):
    other = write_checkpoint(tmp_path / "copy" / "checkpoint", content="fine-tuned")
    server = launch(served_name=served_name(other), model_path=str(other))
    with pytest.raises(CheckpointError, match="serves 'checkpoint@"):
        connect(server)


def test_a_server_started_by_hand_is_known_by_its_directory(launch, connect):
    connect(launch(served_name="/models/checkpoint", model_path="/models/checkpoint"))
    with pytest.raises(CheckpointError, match="'/models/llama'"):
        connect(launch(served_name="/models/llama", model_path="/models/llama"))


def test_a_server_with_another_architecture_is_refused(launch, connect):
    with pytest.raises(CheckpointError, match="LlamaForCausalLM"):
        connect(launch(architecture="LlamaForCausalLM"))


def test_a_server_of_an_untried_release_is_refused(launch, connect):
    with pytest.raises(
        MissingDependencyError, match=r"runs SGLang 0\.4\.9, supported is >=0\.5\.23"
    ):
        connect(launch(version="0.4.9"))


def test_the_api_key_comes_from_the_named_variable(launch, connect, monkeypatch):
    server = launch(key="open sesame")
    with pytest.raises(ConfigurationError, match="refused the API key"):
        connect(server)
    with pytest.raises(ConfigurationError, match="SGLANG_TEST_KEY holds no API key"):
        connect(server, key_variable="SGLANG_TEST_KEY")
    monkeypatch.setenv("SGLANG_TEST_KEY", "open sesame")
    assert connect(server, key_variable="SGLANG_TEST_KEY").run(token_request()).tokens.size == 7


def test_a_server_that_is_not_ready_is_named_after_the_time_is_over(launch, connect):
    server = launch(ready=False)
    started_s = time.monotonic()
    with pytest.raises(NotReadyError, match=r"not ready \(status 503\)"):
        connect(server, start_timeout_s=0.3)
    assert time.monotonic() - started_s < 8.0  # the default is 10 s or more


def test_nobody_listening_is_named(launch, connect):
    server = launch()
    server.stop()
    with pytest.raises(NotReadyError, match=f"{server.url} cannot be reached"):
        connect(server, start_timeout_s=0.3)


def test_an_unencrypted_url_on_a_network_is_warned_about(model, caplog):
    from rn_runtime_sglang.config import SglangRuntimeConfig
    from rn_runtime_sglang.runtime import SglangRuntime

    runtime = SglangRuntime(SglangRuntimeConfig(urls=("http://192.0.2.1:9",), start_timeout_s=0.1))
    with caplog.at_level(logging.WARNING), pytest.raises(NotReadyError):
        runtime.load(model)
    assert "not encrypted" in caplog.text


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "give either python"),
        ({"python": "/x", "urls": ("http://a:1",)}, "give either python"),
        ({"urls": ("http://a:1", "http://a:1/")}, "twice"),
        ({"urls": ("ftp://a:1",)}, "pattern"),
        ({"urls": ("http://a:1/v1",)}, "pattern"),
        ({"urls": ("http://a:1",), "timeout_s": 0}, "greater than 0"),
    ],
)
def test_options_that_make_no_sense_are_refused(options, words):
    from pydantic import ValidationError

    from rn_runtime_sglang.config import SglangRuntimeConfig

    with pytest.raises(ValidationError, match=words):
        SglangRuntimeConfig(**options)


def test_metrics_are_summed_over_labels_and_nonsense_is_passed_over():
    text = 'a{x="1"} 2\na{x="2"} 3.5\nb 7\nc{\na{x="3"} many\n# a 9\n'
    assert parse_metrics(text, {"a": "ours", "b": "other", "c": "none"}) == {
        "ours": 5.5,
        "other": 7.0,
    }
