"""A suite with a stand-in for the simulator: steps, success, idle steps, process failures."""

from __future__ import annotations

import os
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from rn_eval.libero.options import LiberoOptions
from rn_eval.libero.process import SimulatorProcess
from rn_eval.libero.simulator import pipe
from rn_eval.libero.suite import Libero10, LiberoGoal
from rn_eval.plan import EvalPlan
from rn_eval.runner import Runner
from roboneuron import ConfigurationError, NotReadyError
from roboneuron.config import load_config
from roboneuron.plugins.discovery import discover


@pytest.fixture
def play(stand_in):
    runners = []

    def run(actions=None, *, latency="0", suite="libero-goal", limit=None, rows=8):
        config = load_config(None).model_dump(mode="json")
        config["plugins"]["noop"] = {"rows": rows}
        options = {"python": str(stand_in)} | ({} if limit is None else {"step_limit": limit})
        plan = EvalPlan(
            suite=suite,
            suite_options=options,
            backend="noop",
            config=config,
            episodes=1,
            latencies=(latency,),
        )
        runner = Runner(plan)
        runners.append(runner)
        if actions is not None:
            runner._policy_of("none")._rows = np.array(actions)
        return runner.run(next(iter(plan.jobs(plan.build_suite(discover()).episodes(1, 0)))))[
            0
        ].outcome

    yield run
    for runner in runners:
        runner.close()


@pytest.mark.sampled(every=4)
@pytest.mark.parametrize(
    ("suite", "steps"),
    [("libero-spatial", 220), ("libero-object", 280), ("libero-goal", 300), ("libero-10", 520)],
)
def test_an_episode_has_the_protocols_steps_and_chunks_are_played_whole(play, suite, steps):
    outcome = play(suite=suite)
    assert (outcome.status, outcome.rows, outcome.predictions) == (
        "failure",
        steps,
        -(-steps // 8),
    ), outcome.reason
    assert outcome.facts["idle_steps"] == 0.0


@pytest.mark.exhaustive
def test_one_action_models_are_asked_in_every_step(play):
    outcome = play(rows=1, limit=30)
    assert (outcome.rows, outcome.predictions) == (30, 30)


def test_an_episode_ends_with_the_step_that_does_the_task(play):
    close = np.zeros((8, 7))
    outcome = play(close)
    assert (outcome.status, outcome.rows) == ("success", 3)
    assert outcome.duration_s == pytest.approx(0.15)


def test_while_a_prediction_lasts_the_simulation_goes_on(play):
    outcome = play(latency="100ms", limit=20)
    assert outcome.facts["idle_steps"] == 4.0
    assert outcome.rows == 16


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ([1.0, 0, 0, 0, 0, 0, 1], "does not answer: it ended"),
        ([0, 1.0, 0, 0, 0, 0, 1], "the simulation is unstable"),
    ],
)
def test_a_simulator_that_fails_is_an_error_and_says_why(play, row, words):
    outcome = play([[value * 0.05 for value in row[:6]] + [1.0]] * 8)
    assert outcome.status == "error"
    assert words in outcome.reason


def test_a_simulator_that_hangs_is_ended(stand_in):
    process = SimulatorProcess(LiberoOptions(python=stand_in, answer_s=20))
    process.ask(pipe.Open(suite="libero_goal", task=0, state=0, image_px=64), pipe.State)
    process._answer_s = 0.3
    with pytest.raises(NotReadyError, match="no answer within"):
        process.ask(pipe.PipeStep(action=np.array([-1.0, 0, 0, 0, 0, 0, 1])), pipe.State)
    assert process._process.poll() is not None


def test_the_environment_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ConfigurationError, match=r"nowhere/python") as caught:
        SimulatorProcess(LiberoOptions(python=tmp_path / "nowhere/python"))
    assert "make .venv-libero" in str(caught.value)


def test_tasks_take_turns_and_more_episodes_contain_the_same_ones():
    suite = LiberoGoal(None)
    few, many = ({(e.task, e.seed) for e in suite.episodes(count, 0)} for count in (12, 40))
    assert few < many
    assert len({task for task, _ in few}) == 10
    assert max(seed for _, seed in few) == 1
    order = [e.task for e in suite.episodes(40, 0)]
    assert sum(a != b for a, b in pairwise(order)) == 9


def test_there_are_fifty_states():
    assert len(Libero10(None).episodes(500, 0)) == 500
    with pytest.raises(ConfigurationError, match="501"):
        Libero10(None).episodes(501, 0)


def read_from(data):
    left = bytearray(data)

    def read(count):
        if len(left) < count:
            raise pipe.PipeError("end")
        taken, left[:count] = bytes(left[:count]), b""
        return taken

    return read


def frame(header, payload=b""):
    lengths = len(header).to_bytes(4, "little") + len(payload).to_bytes(4, "little")
    return pipe.MAGIC + lengths + header + payload


@pytest.mark.parametrize(
    "data",
    [
        b"GARBAGE" * 8,
        pipe.MAGIC + b"\xff" * 8,
        frame(b"not json"),
        frame(b'{"kind": "Nothing", "fields": {}, "arrays": []}'),
        frame(b'{"kind": "Open", "fields": {"suite": "x"}, "arrays": []}'),
        frame(
            b'{"kind": "Open", "fields": {"suite": 1, "task": 0, "state": 0, "image_px": 9}, '
            b'"arrays": []}'
        ),
        frame(b'{"kind": "Step", "fields": {}, "arrays": [["action", "<f8", [7]]]}', b"\0" * 8),
        frame(b'{"kind": "Step", "fields": {}, "arrays": [["action", "|O", [1]]]}', b"\0" * 8),
        frame(b'{"kind": "Step", "fields": {}, "arrays": [["action", "<f8", [-1]]]}', b"\0" * 8),
        frame(b'{"kind": "Step", "fields": {}, "arrays": [["action", "<f8", [1]]]}', b"\0" * 16),
    ],
)
def test_what_is_not_of_the_protocol_is_refused(data):
    with pytest.raises(pipe.PipeError):
        pipe.receive(read_from(data))


def test_messages_arrive_as_they_were_sent():
    read_end, write_end = os.pipe()
    sent = pipe.State(
        instruction="ü",
        is_done=True,
        joints=np.arange(9.0),
        eef_pos=np.zeros(3),
        eef_quat=np.ones(4),
        flat=np.zeros(2),
    )
    with os.fdopen(write_end, "wb") as sink, os.fdopen(read_end, "rb") as source:
        pipe.send(sink, sent)
        got = pipe.receive(source.read)
    assert isinstance(got, pipe.State)
    assert (got.instruction, got.is_done) == ("ü", True)
    assert np.array_equal(got.joints, sent.joints)


def test_what_is_too_large_is_not_sent():
    sink = SimpleNamespace(write=None, flush=None)
    with pytest.raises(pipe.PipeError, match="too large"):
        pipe.send(sink, pipe.PipeStep(action=np.zeros(pipe.MOST_PAYLOAD_BYTES // 8 + 1)))
