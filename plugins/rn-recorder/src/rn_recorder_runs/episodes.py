"""Episodes of a recorded run: rows of observation and action, without pixels.

An episode covers one instruction. Each sent action is one row. Its observation is the backend's
input, if `predictions` contains it, otherwise the newest one at the time of sending.
"""

from __future__ import annotations

import struct
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rn_recorder_runs.acted import POLICY, ActedRow, Deeds
from rn_recorder_runs.files import read_about
from rn_recorder_runs.reading import camera_of, iterate
from rn_recorder_runs.store import LABELS, WHOLE_RUN, decoded_event
from roboneuron import ACTION_LABEL, ForeignDataError, InvalidInputError, channel_keys

F64 = NDArray[np.float64]
EVENTS = "/roboneuron/events"
EPISODE_END = "episode_end"
"""Event that closes an episode: facts `outcome` and `reason`."""
UNKNOWN = "unknown"
_LAST_NS = 100_000_000
"""Assumed duration of a run's last action, which is not recorded."""
POSE_NAMES = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")


@dataclass(frozen=True, slots=True)
class RecordedAction:
    """One sent action.

    Attributes:
        sent_ns: time of sending [ns].
        values: float64 (n,), contract units.
        label: label of its control space; `roboneuron.channel_keys` names the values by it.
    """

    sent_ns: int
    values: F64
    label: str = ACTION_LABEL


@dataclass(frozen=True, slots=True)
class EpisodeRow:
    """One action and the observation before it.

    Attributes:
        action: float64 (n,), as executed, contract units: the person's where one acted, otherwise
            the policy's; (0,) where a person acted and it is unknown in that space.
        policy_action: float64 (n,), of the policy; not executed where a person acted alone.
        label: label of their control space.
        sent_ns: time of sending of the policy's action [ns].
        images: capture time [ns] by camera.
        joints: float64 (n,), rad or m; empty if there were none.
        ee_pose: float64 (7 n,), x y z [m] and quaternion x y z w of each arm, see
            `Streams.pose_names`; empty if one of them was not measured.
        who: source that moved the arm: "policy", "person" (the policy's action was not executed),
            "blend" (with a person's correction added) or "nobody" (it was held).
    """

    action: F64
    policy_action: F64
    label: str
    sent_ns: int
    images: dict[str, int]
    joints: F64
    ee_pose: F64
    who: str = POLICY


@dataclass(slots=True)
class RecordedEpisode:
    """One instruction of a run."""

    instruction: str
    outcome: str
    run: str
    comment: str = ""
    rows: list[EpisodeRow] = field(default_factory=list)

    @property
    def labels(self) -> tuple[str, ...]:
        """Control spaces of its actions, in the order of their occurrence; several if the policy
        was switched to another space.
        """
        return tuple(dict.fromkeys(row.label for row in self.rows))


@dataclass(frozen=True, slots=True)
class RecordedPrediction:
    """One line of the topic `predictions`; `facts` as `rn_recorder_runs.predictions` writes
    them, `sequence` the publisher's.
    """

    at_ns: int
    facts: dict[str, Any]
    sequence: int = 0


@dataclass(slots=True)
class Streams:
    """The numbers of a run, in order of time; images by their stamps.

    Predictions from images that came before the run began are left out. `poses` are those of the
    first arm; `arm_poses` those of each of several arms by its name. `acting` contains control's
    reports of the source that moved the arm.
    """

    actions: list[RecordedAction] = field(default_factory=list)
    predictions: list[RecordedPrediction] = field(default_factory=list)
    joints: list[tuple[int, F64]] = field(default_factory=list)
    poses: list[tuple[int, F64]] = field(default_factory=list)
    arm_poses: dict[str, list[tuple[int, F64]]] = field(default_factory=dict)
    images: dict[str, list[tuple[int, int]]] = field(default_factory=dict)
    events: list[dict[str, Any]] = field(default_factory=list)
    acting: list[ActedRow] = field(default_factory=list)
    joint_names: tuple[str, ...] = ()

    @property
    def pose_streams(self) -> dict[str, list[tuple[int, F64]]]:
        """The measured TCP poses by arm; "" for the only one."""
        return dict(sorted(self.arm_poses.items())) or {"": self.poses}

    @property
    def pose_names(self) -> tuple[str, ...]:
        """Names of the values of `EpisodeRow.ee_pose`: "x_m"; "left/x_m" of several arms."""
        return tuple(
            f"{arm}/{name}" if arm else name for arm in self.pose_streams for name in POSE_NAMES
        )


def stamp_of(data: bytes) -> int:
    """Stamp of a CDR message that begins with a header [ns].

    Raises:
        ForeignDataError: it is shorter than a stamp.
    """
    if len(data) < 12:
        raise ForeignDataError(f"a recorded message of {len(data)} bytes has no stamp")
    sec, nanosec = struct.unpack_from("<iI", data, 4)
    return int(sec) * 1_000_000_000 + int(nanosec)


def read_streams(files: Sequence[Path]) -> Streams:
    """Read all streams except pixels."""
    found = Streams()
    names = ("action", "acting", "predictions", "joint_states", "ee_pose")
    poses: dict[str, list[tuple[int, F64]]] = {}
    for entry in iterate(
        files, lambda topic: topic == EVENTS or camera_of(topic) != "", decode=False
    ):
        record = entry.record
        if record.topic != EVENTS:
            found.images.setdefault(camera_of(record.topic), []).append(
                (record.log_ns, stamp_of(record.data))
            )
    for entry in iterate(files, lambda topic: topic == EVENTS or topic.rpartition("/")[2] in names):
        record, message = entry.record, entry.message
        name = record.topic.rpartition("/")[2]
        if record.topic == EVENTS:
            found.events.append(decoded_event(message.data))
        elif name == "action":
            dims = message.layout.dim
            label = dims[0].label if dims else ACTION_LABEL
            # planned rows may follow
            data = message.data[: dims[0].size] if len(dims) > 1 else message.data
            # control refuses rows of another size as well
            if len(data) == len(channel_keys(label)):
                values = np.array(data, dtype=np.float64)
                found.actions.append(RecordedAction(record.publish_ns, values, label))
        elif name == "acting":
            found.acting.append(ActedRow.from_message(message, record.publish_ns))
        elif name == "predictions":
            found.predictions.append(
                RecordedPrediction(record.publish_ns, decoded_event(message.data), record.sequence)
            )
        elif name == "joint_states":
            found.joint_names = found.joint_names or tuple(message.name)
            if tuple(message.name) == found.joint_names:
                found.joints.append((record.log_ns, np.array(message.position, dtype=np.float64)))
        elif name == "ee_pose":
            p, q = message.pose.position, message.pose.orientation
            pose = np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])
            poses.setdefault(record.topic, []).append((record.log_ns, pose))
    _sort_poses(found, poses)
    found.actions.sort(key=lambda action: action.sent_ns)
    found.acting.sort(key=lambda row: row.at_ns)
    first_ns = {
        camera: min(stamp_ns for _, stamp_ns in seen) for camera, seen in found.images.items()
    }
    found.predictions = [
        prediction
        for prediction in sorted(found.predictions, key=lambda prediction: prediction.at_ns)
        if all(
            f["stamp_ns"] >= first_ns.get(f["camera"], 0)
            for f in prediction.facts.get("frames", {}).values()
        )
    ]
    return found


def _sort_poses(found: Streams, poses: dict[str, list[tuple[int, F64]]]) -> None:
    """Separate the robot's own TCP from those of several arms.

    Args:
        found: receives them.
        poses: by topic: `/<robot>/ee_pose`, and `/<robot>/<arm>/ee_pose`.
    """
    own = min(poses, key=len, default="")
    base = own.removesuffix("ee_pose")
    for topic, stream in poses.items():
        if topic == own:
            found.poses = stream
        elif topic.startswith(base):
            found.arm_poses[topic.removeprefix(base).removesuffix("/ee_pose")] = stream


def read_episodes(
    run: str, files: Sequence[Path], facts: Mapping[str, object]
) -> tuple[list[RecordedEpisode], Streams]:
    """The episodes of a run, oldest first; those without an action are left out.

    Raises:
        InvalidInputError: it contains no images, or no actions.
    """
    streams = read_streams(files)
    if not streams.actions or not streams.images:
        what = "actions" if not streams.actions else "images"
        raise InvalidInputError(f"The run {run!r} holds no {what}, so it is no demonstration.")
    told = str(facts.get("outcome") or UNKNOWN)
    fallback = str(facts.get("note") or read_about(files[0]).get("name") or run)
    cuts = _cuts(streams, fallback)
    ends = sorted(
        (int(e["at_ns"]), str(e.get("outcome", UNKNOWN)))
        for e in streams.events
        if e["what"] == EPISODE_END
    )
    episodes: list[RecordedEpisode] = []
    for number, (begin_ns, instruction) in enumerate(cuts):
        until_ns = cuts[number + 1][0] if number + 1 < len(cuts) else 2**63
        end = next(((at, word) for at, word in ends if begin_ns <= at < until_ns), None)
        last_ns, outcome = (
            end if end is not None else (until_ns, told if len(cuts) == 1 else UNKNOWN)
        )
        rows = _rows(streams, begin_ns, min(last_ns, until_ns))
        if rows:
            label = _label(facts, len(episodes))
            word = label.get("outcome", outcome)
            comment = label.get("comment", "")
            episodes.append(RecordedEpisode(instruction, word, run, comment, rows))
    return episodes, streams


def _label(facts: Mapping[str, object], episode: int) -> dict[str, str]:
    """Label given by a person to an episode, or to its whole run; see `RunStore.label`."""
    labels = facts.get(LABELS)
    if not isinstance(labels, Mapping):
        return {}
    return {**labels.get(WHOLE_RUN, {}), **labels.get(str(episode), {})}


def _cuts(streams: Streams, fallback: str) -> list[tuple[int, str]]:
    """Start of each instruction [ns]: from predictions, else from calls that gave one, else one for
    the whole run.
    """
    found: list[tuple[int, str]] = []
    for prediction in streams.predictions:
        instruction = str(prediction.facts.get("instruction", ""))
        if not found or found[-1][1] != instruction or prediction.facts.get("resets"):
            found.append((prediction.at_ns, instruction))
    if not found:
        for event in streams.events:
            given = event.get("arguments")
            if (
                event["what"] == "call"
                and not event.get("error")
                and isinstance(given, dict)
                and given.get("instruction")
            ):
                found.append((int(event["at_ns"]), str(given["instruction"])))
    return found or [(0, fallback)]


def _rows(streams: Streams, begin_ns: int, end_ns: int) -> list[EpisodeRow]:
    times = [action.sent_ns for action in streams.actions]
    predicted = [prediction.at_ns for prediction in streams.predictions]
    image_times = {camera: [at for at, _ in seen] for camera, seen in streams.images.items()}
    joint_times = [at for at, _ in streams.joints]
    pose_streams = streams.pose_streams
    pose_times = {arm: [at for at, _ in seen] for arm, seen in pose_streams.items()}
    deeds = Deeds(streams.acting)
    rows: list[EpisodeRow] = []
    used = -1
    for index in range(bisect_right(times, begin_ns - 1), len(times)):
        action = streams.actions[index]
        sent_ns = action.sent_ns
        if sent_ns > end_ns:
            break
        images = {
            camera: streams.images[camera][place - 1][1]
            for camera, seen in image_times.items()
            if (place := bisect_right(seen, sent_ns)) > 0
        }
        joints = _newest(streams.joints, joint_times, sent_ns)
        poses = {arm: _newest(seen, pose_times[arm], sent_ns) for arm, seen in pose_streams.items()}
        latest = bisect_right(predicted, sent_ns) - 1
        if latest > used:  # the first action of a chunk: the backend's input is known
            used = latest
            facts = streams.predictions[latest].facts
            for frame in facts.get("frames", {}).values():
                if frame["camera"] in images:
                    images[frame["camera"]] = int(frame["stamp_ns"])
            if "joints" in facts and tuple(facts["joints"]["names"]) == streams.joint_names:
                joints = np.array(facts["joints"]["position"])
            poses |= {arm: pose for arm, pose in _seen_poses(facts).items() if arm in poses}
        if len(images) == len(image_times):
            is_whole = all(pose.size for pose in poses.values())
            pose = np.concatenate(list(poses.values())) if is_whole else np.zeros(0)
            until_ns = times[index + 1] if index + 1 < len(times) else sent_ns + _LAST_NS
            deed = deeds.next(action.values, action.label, sent_ns, until_ns)
            rows.append(
                EpisodeRow(
                    action=deed.action,
                    policy_action=action.values,
                    label=action.label,
                    sent_ns=sent_ns,
                    images=images,
                    joints=joints,
                    ee_pose=pose,
                    who=deed.who,
                )
            )
    return rows


def _seen_poses(facts: dict[str, Any]) -> dict[str, F64]:
    """TCP poses in the backend's input, by arm."""
    told = dict(facts.get("arms", {}))
    if "ee_pose" in facts:
        told[""] = facts["ee_pose"]
    return {
        arm: np.array([*pose["position_m"], *pose["quaternion_xyzw"]]) for arm, pose in told.items()
    }


def _newest(stream: list[tuple[int, F64]], times: list[int], at_ns: int) -> F64:
    place = bisect_right(times, at_ns)
    return stream[place - 1][1] if place else np.zeros(0)
