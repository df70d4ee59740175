"""Input and answer of a backend as one line of JSON, from which a recording is replayed exactly."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from roboneuron import ActionChunk, Observation
from roboneuron.feature import topics

if TYPE_CHECKING:
    from roboneuron.feature import Module, ModuleHost
    from roboneuron.modules.inference.execution import Prediction

_MOST_KEPT = 20


def join(host: ModuleHost) -> None:
    """Make the inference module publish its predictions; called in every module process, see
    `FeatureSpec.on_join`.
    """
    if host.settings.kind == "inference":
        host.on_configured.append(_extend)


def _extend(module: Module) -> None:
    from std_msgs.msg import String  # heavy

    from roboneuron.modules.step_filters import StepFilter

    output = module.node.advertise(String, topics.PREDICTIONS)
    records = PredictionRecords()

    class PublishedPredictions(StepFilter):
        """Publishes what was predicted, before its rows are sent."""

        def note_answer(
            self, prediction: Prediction, resets: bool, answer: ActionChunk | Exception
        ) -> None:
            """See `StepFilter.note_answer`."""
            is_heard = output.get_subscription_count() > 0
            seen, mode = prediction.observation, prediction.mode
            for text in records(seen, mode, resets, answer, is_heard):
                output.publish(String(data=text))

    module.filters.add(PublishedPredictions())


class PredictionRecords:
    """Records of the predictions that have a subscriber, and of those since a recent reset.

    A recorder discovers the topic shortly after the first predictions. Without these, a stateful
    backend cannot be replayed.
    """

    def __init__(self) -> None:
        self._kept: list[str] | None = None

    def __call__(
        self,
        observation: Observation,
        mode: str,
        resets: bool,
        answer: ActionChunk | Exception,
        is_heard: bool,
    ) -> Sequence[str]:
        """Records to publish now, oldest first; the arguments are those of `prediction_record`."""
        kept = [] if resets else self._kept
        self._kept = None
        if not is_heard and kept is None:
            return ()
        records = [*(kept or ()), prediction_record(observation, mode, resets, answer)]
        if is_heard:
            return records
        if len(records) <= _MOST_KEPT:
            self._kept = records
        return ()


def prediction_record(
    observation: Observation, mode: str, resets: bool, answer: ActionChunk | Exception
) -> str:
    """Format one prediction.

    Observations are identified by their stamps [ns]; state and rows are included, in the contract's
    units (numbers in JSON keep every bit of a float64). `space` is the label of the rows' control
    space. `ahead` contains the rows played meanwhile, without the backend's own context.

    Args:
        observation: input of the backend.
        mode: execution mode of its answer.
        resets: the backend was reset just before.
        answer: the chunk, or the error.
    """
    joints, pose, ahead = observation.joints, observation.ee_pose, observation.ahead
    record: dict[str, Any] = {
        "instruction": observation.instruction,
        "resets": resets,
        "mode": mode,
        "stamp_ns": observation.stamp_ns,
        "frames": {
            role: {"camera": f.camera, "stamp_ns": f.stamp_ns}
            for role, f in observation.frames.items()
        },
        "gripper_open": observation.gripper_open,
    }
    if joints is not None:
        record["joints"] = {
            "names": joints.names,
            "position": joints.position.tolist(),
            "stamp_ns": joints.stamp_ns,
        }
        record["joints"]["velocity"] = None if joints.velocity is None else joints.velocity.tolist()
    if pose is not None:
        record["ee_pose"] = {
            "position_m": pose.position_m.tolist(),
            "quaternion_xyzw": pose.quaternion_xyzw.tolist(),
        }
        record["ee_pose"]["stamp_ns"] = pose.stamp_ns
    if observation.arms:
        record["arms"] = {
            name: {
                "position_m": arm.ee_pose.position_m.tolist(),
                "quaternion_xyzw": arm.ee_pose.quaternion_xyzw.tolist(),
                "stamp_ns": arm.ee_pose.stamp_ns,
                "gripper_open": arm.gripper_open,
            }
            for name, arm in observation.arms.items()
        }
    if ahead is not None:
        record["ahead"] = {
            "rows": ahead.rows.tolist(),
            "committed_rows": ahead.committed_rows,
            "step_s": ahead.step_s,
        }
        record["ahead"] |= {"context_row": ahead.context_row, "state_ahead_s": ahead.state_ahead_s}
    if isinstance(answer, Exception):
        record["error"] = str(answer)
    else:
        record |= {"rows": answer.actions.tolist(), "step_s": answer.step_s, "note": answer.note}
        record |= {"conditioned_rows": answer.conditioned_rows, "space": answer.space.label}
    return json.dumps(record)
