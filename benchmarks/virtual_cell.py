"""Simulation of chunk execution with a virtual clock: a policy, a latency and an arm, without
processes, ROS or waiting.

It uses the executor of the inference module. The task is to follow a target that circles in either
direction while it drifts, so that chunks from different images disagree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from roboneuron.contract import ActionChunk, Ahead, Frame, Observation, Pose
from roboneuron.errors import NotReadyError
from roboneuron.modules.execution.adaptive import AdaptiveExecutor
from roboneuron.modules.execution.meter import RowDelivery
from roboneuron.modules.execution.mode import Abilities, Mode
from roboneuron.modules.inference import execution

F64 = NDArray[np.float64]
_CAMERA_HZ = 30.0
_LAG_S = 0.020
_RADIUS_M, _TURN_RAD_S = 0.040, 2.0
_TICK_S = 0.002
_GAIN = 0.15
"""Fraction of its distance to the target that the policy covers in one row."""
_DOWN = np.array([1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, kw_only=True, slots=True)
class Trial:
    """Parameters of a run.

    Attributes:
        horizon: rows of a chunk.
        latency_s: median of the time that one prediction takes [s]; lognormal.
        jitter: standard deviation of its logarithm.
        mode: fixed mode; None to choose.
        abilities: of the policy. With `conditions_on_rows` it continues the committed rows exactly
            and then blends into its own plan, as a conditioned flow policy does.
        step_s: period of the rows [s].
        duration_s: duration of the run [s].
        seed: seed of latency and policy.
    """

    horizon: int = 8
    latency_s: float = 0.112
    jitter: float = 0.2
    mode: Mode | None = None
    abilities: Abilities = field(default_factory=Abilities)
    step_s: float = 0.05
    duration_s: float = 45.0
    seed: int = 0


@dataclass(slots=True)
class Outcomes:
    """Results of a run.

    Attributes:
        delivery: statistics as in the status.
        rate: ratio of sent to wanted rows, from the second row on, 0 .. 1.
        mode: in force at the end.
        outcomes: number of answers by result.
        rms_error_m: distance from arm to target [m].
        played: (prediction's number, row) of every row sent, in order.
        image_age_s: mean age of the image behind a row when it was sent [s].
    """

    delivery: RowDelivery
    rate: float
    mode: Mode
    outcomes: dict[str, int]
    rms_error_m: float
    played: list[tuple[int, int]]
    image_age_s: float


def target_m(at_s: float, sense: float) -> F64:
    """Position of the target circling in that sense, 1 or -1: float64 (3,)."""
    angle = _TURN_RAD_S * at_s * sense
    drift_m = 0.05 * math.sin(0.3 * at_s)
    return np.array([_RADIUS_M * math.cos(angle) + drift_m, _RADIUS_M * math.sin(angle), 0.0])


@dataclass(slots=True)
class VirtualPolicy:
    """Policy with deltas that lead from the observed TCP to the target's future position.

    Attributes:
        horizon: rows of a chunk.
        step_s: their period [s].
        conditions_on_rows: it continues the committed rows.
        random: draws the sense of rotation.
        sense: sense of the newest prediction, 1 or -1.
    """

    horizon: int
    step_s: float
    conditions_on_rows: bool
    random: np.random.Generator
    sense: float = 1.0

    def predict(self, at_s: float, tcp_m: F64, ahead: Ahead | None) -> ActionChunk:
        """Return the chunk for an image captured at that time, with the TCP there."""
        start_s = at_s + (ahead.state_ahead_s if ahead is not None else 0.0)
        if self.random.random() < 0.2:
            self.sense = -self.sense
        here_m, rows, conditioned = tcp_m, [], 0
        committed: F64 = np.zeros((0, 7))
        if ahead is not None and self.conditions_on_rows:
            committed = ahead.rows[: ahead.committed_rows]
        for i in range(self.horizon):
            at = start_s + i * self.step_s
            here_target_m, next_m = target_m(at, self.sense), target_m(at + self.step_s, self.sense)
            delta_m = next_m - here_target_m + _GAIN * (here_target_m - here_m)
            if i < len(committed):
                delta_m, conditioned = committed[i][:3], conditioned + 1
            elif len(committed):  # blends from the last committed row into the plan over four rows
                share = min(1.0, (i - len(committed) + 1) / 5.0)
                delta_m = (1.0 - share) * committed[-1][:3] + share * delta_m
            rows.append([*delta_m, 0.0, 0.0, 0.0, float(self.sense > 0)])
            here_m = here_m + delta_m
        return ActionChunk(actions=np.array(rows), step_s=self.step_s, conditioned_rows=conditioned)


@dataclass(slots=True)
class _Cell:
    policy: VirtualPolicy
    tcp_m: F64 = field(default_factory=lambda: np.zeros(3))
    goal_m: F64 = field(default_factory=lambda: np.zeros(3))


def run(trial: Trial) -> Outcomes:
    """Run one trial; equal trials have equal results."""
    executor = AdaptiveExecutor(
        trial.abilities, fixed=trial.mode, bounds=execution.Bounds(first_s=60.0, tail_s=60.0)
    )
    random = np.random.default_rng(trial.seed)
    cell = _Cell(
        VirtualPolicy(trial.horizon, trial.step_s, trial.abilities.conditions_on_rows, random)
    )
    executor.begin_epoch()
    outcomes: dict[str, int] = {}
    played: list[tuple[int, int]] = []
    numbers: dict[int, int] = {}
    errors_m, ages_s = [], []
    pending: tuple[float, execution.Prediction, ActionChunk] | None = None
    first_s = last_s = None
    image = np.zeros((1, 1, 3), np.uint8)
    captured_s, used_s, now_s = -1.0, -1.0, 0.0
    while now_s < trial.duration_s:
        now_ns = round(now_s * 1e9)
        captured_s = math.floor(now_s * _CAMERA_HZ + 1e-9) / _CAMERA_HZ
        if pending is not None and now_s >= pending[0]:
            outcome = executor.answer(pending[1], pending[2], now_ns)
            outcomes[outcome] = outcomes.get(outcome, 0) + 1
            numbers[pending[1].captured_ns] = len(numbers)
            pending = None
        if pending is None and captured_s > used_s and executor.wants_prediction(now_s):
            used_s = captured_s
            captured_ns = round(captured_s * 1e9)
            observation = Observation(
                frames={
                    "primary": Frame(
                        camera="front", image=image, stamp_ns=captured_ns, frame_id="front"
                    )
                },
                instruction="follow",
                ee_pose=Pose(position_m=cell.tcp_m, quaternion_xyzw=_DOWN, stamp_ns=captured_ns),
                gripper_open=1.0,
                stamp_ns=captured_ns,
            )
            prediction = executor.begin(observation, captured_ns)
            latency_s = trial.latency_s * math.exp(trial.jitter * random.standard_normal())
            pose = prediction.observation.ee_pose
            assert pose is not None
            chunk = cell.policy.predict(captured_s, pose.position_m, prediction.observation.ahead)
            pending = (now_s + latency_s, prediction, chunk)
        try:
            row = executor.play(now_s, now_ns)
        except NotReadyError:
            row = None
        if row is not None:
            cell.goal_m = cell.tcp_m + row.vector[:3]
            played.append((numbers[row.oldest_ns], row.index))
            ages_s.append(now_s - row.oldest_ns / 1e9)
            first_s = now_s if first_s is None else first_s
            last_s = now_s
        cell.tcp_m = cell.tcp_m + (cell.goal_m - cell.tcp_m) * min(1.0, _TICK_S / _LAG_S)
        errors_m.append(float(np.linalg.norm(cell.tcp_m - target_m(now_s, cell.policy.sense))))
        now_s = round(now_s + _TICK_S, 6)
    assert first_s is not None
    assert last_s is not None
    status = executor.status()
    return Outcomes(
        delivery=status.delivery,
        rate=(len(played) - 1) * trial.step_s / max(last_s - first_s, trial.step_s),
        mode=status.choice.mode,
        outcomes=outcomes,
        rms_error_m=float(np.sqrt(np.mean(np.square(errors_m)))),
        played=played,
        image_age_s=float(np.mean(ages_s)),
    )
