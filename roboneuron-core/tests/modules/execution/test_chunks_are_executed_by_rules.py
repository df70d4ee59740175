"""Rules of chunk execution: rows are counted when sent, never sent twice; seams are smooth;
interruptions are final.
"""

from __future__ import annotations

import numpy as np
import pytest

from roboneuron.contract import ActionChunk, Frame, Observation, Pose
from roboneuron.errors import InvalidInputError, NotReadyError
from roboneuron.modules.execution.adaptive import AdaptiveExecutor
from roboneuron.modules.execution.latency import LatencyWindow
from roboneuron.modules.execution.mode import Abilities, Mode, ModeSelector, choose
from roboneuron.modules.execution.queue import SentRowQueue, cross_fade
from roboneuron.modules.inference.execution import Bounds

STEP_S = 0.05
STEP_NS = round(STEP_S * 1e9)
IMAGE = np.zeros((1, 1, 3), np.uint8)


def chunk(rows: int, first_m: float = 0.0, *, conditioned_rows: int = 0) -> ActionChunk:
    """Row i moves by `first_m` + i millimetres, so that each row tells which it is."""
    actions = np.zeros((rows, 7))
    actions[:, 0] = first_m + np.arange(rows) * 1e-3
    return ActionChunk(
        actions=actions, step_s=STEP_S, context=first_m, conditioned_rows=conditioned_rows
    )


def send(queue: SentRowQueue, times: int, at_ns: int = 0) -> int:
    for _ in range(times):
        queue.pop(at_ns)
        at_ns += STEP_NS
    return at_ns


def observation(captured_ns: int) -> Observation:
    return Observation(
        frames={
            "primary": Frame(camera="front", image=IMAGE, stamp_ns=captured_ns, frame_id="front")
        },
        instruction="go",
        ee_pose=Pose(
            position_m=np.zeros(3),
            quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0]),
            stamp_ns=captured_ns,
        ),
        gripper_open=1.0,
        stamp_ns=captured_ns,
    )


def test_an_answer_replaces_the_queue_from_the_row_that_is_next() -> None:
    queue = SentRowQueue(fade_rows=0)
    queue.replace(chunk(8), 0)
    now_ns = send(queue, 2)
    captured_ns = now_ns - 1
    send(queue, 3, now_ns)
    assert queue.replace(chunk(8, 1.0), captured_ns) == "accepted"
    assert queue.rows[0].vector[0] == pytest.approx(1.003)
    assert [queue.pop(0).index for _ in range(len(queue.rows))] == [3, 4, 5, 6, 7]


def test_rows_are_counted_not_timed() -> None:
    """An answer after five periods in which nothing was sent starts with its first row."""
    queue = SentRowQueue()
    assert queue.replace(chunk(8), 0) == "accepted"
    send(queue, 8)
    captured_ns = 100 * STEP_NS
    assert queue.replace(chunk(8), captured_ns) == "accepted"
    assert queue.rows[0].index == 0


def test_an_answer_without_a_row_in_time_is_late() -> None:
    queue = SentRowQueue()
    queue.append(chunk(8))
    send(queue, 4)
    assert queue.replace(chunk(4), 0) == "late"
    assert len(queue.rows) == 4


def test_rows_of_a_predecessor_count() -> None:
    queue = SentRowQueue()
    queue.note_sent(np.zeros(7), 10)
    queue.note_sent(np.zeros(7), 20)
    queue.replace(chunk(8), 15)
    assert queue.rows[0].index == 1


@pytest.mark.parametrize("mode", ["sequential", "overlap"])
def test_an_epoch_ends_rows_and_answers(mode: Mode) -> None:
    made = AdaptiveExecutor(Abilities(), fixed=mode, bounds=Bounds(first_s=9.0))
    late = made.begin(observation(0), 0)
    assert made.answer(late, chunk(8), now_ns=0) == "accepted"
    assert made.play(0.0, 0) is not None
    made.begin_epoch()
    assert made.due_s() is None
    assert made.answer(late, chunk(8), now_ns=1) == "withdrawn"
    # none counts as played
    assert made.answer(made.begin(observation(0), 0), chunk(1), now_ns=1) == "accepted"


def test_an_epoch_forgets_what_was_sent() -> None:
    queue = SentRowQueue()
    queue.append(chunk(8))
    send(queue, 2)
    queue.begin_epoch()
    assert len(queue.rows) == 0
    assert queue.sent_since(0) == 0


def test_a_trained_prefix_that_was_overrun_is_left_out_once_then_faded() -> None:
    queue = SentRowQueue()
    queue.append(chunk(16))
    send(queue, 5)
    late = chunk(16, 1.0, conditioned_rows=3)
    assert queue.replace(late, 0, max_committed_rows=3) == "unconditioned"
    assert queue.replace(late, 0, max_committed_rows=3) == "accepted"
    assert queue.rows[0].vector[0] < 1.0  # faded


def test_a_conditioned_answer_is_not_faded() -> None:
    queue = SentRowQueue()
    queue.append(chunk(16))
    send(queue, 2)
    queue.replace(chunk(16, 1.0, conditioned_rows=4), 0)
    assert queue.rows[0].vector[0] == pytest.approx(1.002)


def test_deltas_are_faded_and_the_gripper_is_not() -> None:
    old = [np.array([0.0] * 6 + [0.0])] * 3
    new = np.array([[1.0] * 6 + [1.0]] * 5)
    faded = cross_fade(old, new, 4)
    np.testing.assert_allclose(faded[:, 0], [0.25, 0.5, 0.75, 1.0, 1.0])
    np.testing.assert_array_equal(faded[:, 6], 1.0)


@pytest.mark.parametrize(("horizon", "faded"), [(4, 0), (5, 1), (6, 2), (8, 4), (16, 4)])
def test_a_fade_leaves_most_of_a_short_chunk_as_it_was_predicted(horizon: int, faded: int) -> None:
    queue = SentRowQueue()
    queue.replace(chunk(horizon), 0)
    queue.replace(chunk(horizon, 1.0), 0)
    played = [queue.pop(0).vector[0] for _ in range(horizon)]
    assert sum(abs(x - 1.0 - i * 1e-3) > 1e-9 for i, x in enumerate(played)) == faded


@pytest.mark.parametrize(("horizon", "played"), [(4, 3), (5, 3), (6, 3), (8, 3), (16, 11)])
def test_overlap_asks_again_when_the_rows_run_out_not_at_each_image(
    horizon: int, played: int
) -> None:
    """With answers at once a new chunk is asked for when one row is left, and those to be faded."""
    made = AdaptiveExecutor(Abilities(), fixed="overlap", bounds=Bounds(first_s=9.0))
    made.answer(made.begin(observation(0), 0), chunk(horizon), now_ns=0)
    sent = 0
    while not made.wants_prediction(sent * STEP_S):
        assert made.play(sent * STEP_S, round(sent * STEP_NS)) is not None
        sent += 1
    assert sent == played


def test_ahead_holds_what_was_sent_since_the_capture_and_what_is_planned() -> None:
    queue = SentRowQueue(fade_rows=0)
    queue.append(chunk(8, 0.5))
    now_ns = send(queue, 3)
    ahead = queue.ahead(now_ns - STEP_NS, 4, STEP_S)
    assert ahead is not None
    np.testing.assert_allclose(ahead.rows[:, 0], 0.5 + np.arange(2, 8) * 1e-3)
    assert (ahead.committed_rows, ahead.context, ahead.context_row) == (4, 0.5, 2)
    queue.begin_epoch()
    assert queue.ahead(0, 4, STEP_S) is None


def test_rows_ahead_are_checked() -> None:
    from roboneuron.contract import Ahead

    with pytest.raises(InvalidInputError, match="committed_rows is 3 of 2"):
        Ahead(rows=np.zeros((2, 7)), committed_rows=3, step_s=STEP_S)
    with pytest.raises(InvalidInputError, match="conditioned_rows is 9"):
        chunk(8, conditioned_rows=9)


@pytest.mark.parametrize(
    ("horizon", "typical", "worst", "mode"),
    [
        (8, 2, 3, "overlap"),
        (8, 3, 4, "overlap"),  # pauses now and then, less than sequential execution
        (8, 9, 12, "sequential"),
        (16, 7, 7, "overlap"),
        (1, 1, 1, "sequential"),
    ],
)
def test_latency_and_horizon_choose(horizon: int, typical: int, worst: int, mode: str) -> None:
    assert choose(horizon, typical, worst, Abilities()).mode == mode


def test_abilities_choose() -> None:
    assert choose(16, 2, 3, Abilities(conditions_on_rows=True)).mode == "rtc"
    assert (
        choose(16, 2, 3, Abilities(conditions_on_rows=True, max_committed_rows=2)).mode == "overlap"
    )
    assert choose(8, 4, 5, Abilities(takes_predicted_state=True)).mode == "predicted-state"


def test_the_mode_changes_after_ten_answers_that_agree() -> None:
    selector, latency = ModeSelector(None, Abilities()), LatencyWindow(size=1)
    latency.add(0.1)
    for _ in range(2):
        latency.add(0.1)
        assert selector.update(8, STEP_S, latency).mode == "overlap"
    latency.add(0.6)
    assert [selector.update(8, STEP_S, latency).mode for _ in range(10)] == ["overlap"] * 9 + [
        "sequential"
    ]


def test_a_spike_is_forgotten() -> None:
    latency = LatencyWindow(size=50)
    for value in (9.0, 0.1, 2.0, *[0.1] * 50):
        latency.add(value)
    assert latency.p99_s == pytest.approx(0.1)


def test_the_first_answer_after_a_reset_does_not_count() -> None:
    latency = LatencyWindow()
    latency.add(3.0)
    assert latency.p99_s == 3.0  # better than nothing
    latency.add(0.1)
    latency.skip_next()
    latency.add(3.0)
    assert latency.p99_s == pytest.approx(0.1)


def executor(**options: object) -> AdaptiveExecutor:
    bounds = Bounds(first_s=0.5)
    return AdaptiveExecutor(Abilities(), fixed=None, bounds=bounds, **options)  # type: ignore[arg-type]


def test_a_row_is_not_sent_when_its_image_is_too_old() -> None:
    made = executor()
    prediction = made.begin(observation(0), 0)
    made.answer(prediction, chunk(8), now_ns=int(0.4e9))
    with pytest.raises(NotReadyError, match=r"row 1 of 8 was 0\.60 s old"):
        made.play(0.6, int(0.6e9))
    assert made.due_s() is None


def test_the_tail_of_a_chunk_has_a_bound_of_its_own() -> None:
    made = AdaptiveExecutor(Abilities(), fixed="sequential", bounds=Bounds(first_s=0.5, tail_s=0.6))
    made.answer(made.begin(observation(0), 0), chunk(8), now_ns=int(0.4e9))
    for at_s in (0.45, 0.51, 0.57):
        assert made.play(at_s, int(at_s * 1e9)) is not None
    with pytest.raises(NotReadyError, match=r"row 4 of 8 was 0\.63 s old"):
        made.play(0.63, int(0.63e9))
    assert made.due_s() is None


def test_rows_keep_their_period() -> None:
    made = executor()
    made.answer(made.begin(observation(0), 0), chunk(8), now_ns=0)
    assert made.play(0.0, 0) is not None
    assert made.play(STEP_S * 0.9, 1) is None
    assert made.play(STEP_S * 1.1, 2) is not None  # jitter: the grid stays
    assert made.due_s() == pytest.approx(2 * STEP_S)
    assert made.play(STEP_S * 4, 3) is not None  # a pause: the grid starts anew
    assert made.due_s() == pytest.approx(5 * STEP_S)
    assert made.status().delivery.starved_periods == 2


def test_the_state_is_measured_unless_the_backend_takes_a_predicted_one() -> None:
    able = Abilities(takes_predicted_state=True)
    made = AdaptiveExecutor(able, fixed="predicted-state", bounds=Bounds(first_s=0.5))
    made.answer(made.begin(observation(0), 0), chunk(4, 0.01), now_ns=0)
    made.play(0.0, 0)
    rolled = made.begin(observation(1), 1).observation
    assert rolled.ee_pose is not None
    assert rolled.ahead is not None
    assert rolled.ahead.state_ahead_s == pytest.approx(4 * STEP_S, abs=1e-6)
    assert rolled.ee_pose.position_m[0] == pytest.approx(0.046, abs=1e-6)
    other = executor()
    other.answer(other.begin(observation(0), 0), chunk(4, 0.01), now_ns=0)
    assert other.begin(observation(1), 1).observation.ahead is None


@pytest.mark.parametrize("mode", ["sequential", "overlap"])
def test_what_is_planned_is_what_will_be_sent_within_the_horizon(mode: Mode) -> None:
    made = AdaptiveExecutor(Abilities(), fixed=mode, bounds=Bounds(first_s=9.0))
    assert made.answer(made.begin(observation(0), 0), chunk(8), now_ns=0) == "accepted"
    row = made.play(0.0, 0)
    assert row is not None
    planned = made.planned(row.step_s, 3 * STEP_S)
    assert [round(vector[0] * 1e3) for vector in planned] == [1, 2, 3]
    later = [made.play(STEP_S * n, STEP_NS * n) for n in (1, 2, 3)]
    assert [one.vector[0] for one in later if one is not None] == [v[0] for v in planned]
    assert len(made.planned(row.step_s, 10.0)) == 4
    assert made.planned(2 * row.step_s, 10.0) == []
    made.begin_epoch()
    assert made.planned(row.step_s, 10.0) == []
