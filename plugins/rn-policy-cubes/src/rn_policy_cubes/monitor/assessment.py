"""How well the monitor judges recorded episodes, as a task sees it: picture by picture, with the
guard against frozen cameras.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from rn_policy_cubes.demonstrations import COLOURS, SIDE_PX
from rn_policy_cubes.monitor.episodes import HELD_S, KINDS, SUCCESS, InjectedEpisode, read_episode
from rn_policy_cubes.monitor.statistics import area, upper_bound
from rn_policy_cubes.monitor.success import COUNTS, CubesSuccess
from rn_policy_cubes.monitor.weights import MonitorWeights
from rn_robot_fr3.cameras import cameras
from rn_standard.tasks.pictures import FrozenPictures
from roboneuron import Frame, Observation, Pose

_ROUNDING_S = 0.02
"""The simulator looks at its cubes every 1/60 s."""


@dataclass(frozen=True, kw_only=True, slots=True)
class JudgedEpisode:
    """What the monitor said in one episode.

    Attributes:
        kind, seed: of the episode.
        is_success: whether the simulator calls it a success.
        success, failure: highest raw probability of each; 0 while the monitor is absent.
        claimed_s: time from the true success until the monitor claims it [s]; None if it never
            does.
        is_false_claim: it claims success at a moment at which it is none.
        noticed_s: time from the failure until the monitor says so [s]; None if it never does, or if
            there is none.
        is_false_alarm: it calls a success a failure.
        absent: share of the pictures for which there was no judgement.
        first_progress, last_progress: its progress at the first and last judgement.
    """

    kind: str
    seed: int
    is_success: bool
    success: float
    failure: float
    claimed_s: float | None
    is_false_claim: bool
    noticed_s: float | None
    is_false_alarm: bool
    absent: float
    first_progress: float
    last_progress: float


def judge_episode(recording: InjectedEpisode, weights: MonitorWeights) -> JudgedEpisode:
    """Show an episode to the monitor."""
    monitor, pictures = CubesSuccess.of(weights), FrozenPictures()
    raw: list[tuple[float, float]] = []
    progress: list[float] = []
    claims: list[float] = []
    alarms: list[float] = []
    false_claim, absent = False, 0
    true_s = recording.succeeded_s
    is_success = recording.kind == SUCCESS and true_s is not None
    first = True
    for view, seen in zip(recording.views, observations(recording), strict=True):
        now_s = float(view["time_s"])
        if first:
            monitor.reset(seen)
            first = False
        if pictures.look(seen, now_s):
            absent += 1
            continue
        score = monitor.score(seen)
        if score.value is None:
            absent += 1
            continue
        raw.append(monitor.raw)
        progress.append(score.progress or 0.0)
        if score.value >= COUNTS:
            claims.append(now_s)
            is_true = is_success and view["held_s"][recording.target] >= HELD_S - _ROUNDING_S
            false_claim |= not is_true
        elif (score.failure or 0.0) >= COUNTS:
            alarms.append(now_s)
    late = [at_s for at_s in alarms if at_s >= recording.failed_s]
    highest = np.max(raw, axis=0) if raw else np.zeros(2)
    return JudgedEpisode(
        kind=recording.kind,
        seed=recording.seed,
        is_success=is_success,
        success=float(highest[0]),
        failure=float(highest[1]),
        claimed_s=round(claims[0] - true_s, 3) if is_success and claims and true_s else None,
        is_false_claim=false_claim,
        noticed_s=round(late[0] - recording.failed_s, 3) if not is_success and late else None,
        is_false_alarm=is_success and bool(alarms),
        absent=absent / len(recording.views),
        first_progress=progress[0] if progress else 0.0,
        last_progress=progress[-1] if progress else 0.0,
    )


def observations(recording: InjectedEpisode) -> Iterable[Observation]:
    """The episode's pictures as a task's snapshots deliver them."""
    calibration = cameras()[0].calibration(SIDE_PX, SIDE_PX)
    instruction = f"pick up the {COLOURS[recording.target]} cube"
    # stamps of 0 mean "unknown", so the clock begins at 1 s
    for view, picture in zip(recording.views, recording.pictures, strict=True):
        frame = Frame(
            camera="front",
            image=picture,
            stamp_ns=round((float(view["stamp_s"]) + 1.0) * 1e9),
            frame_id="front",
            calibration=calibration,
        )
        pose = Pose(
            position_m=view["tcp_m"].astype(np.float64),
            quaternion_xyzw=np.array([1.0, 0.0, 0.0, 0.0]),
            stamp_ns=round((float(view["time_s"]) + 1.0) * 1e9),
        )
        yield Observation(
            frames={"primary": frame},
            instruction=instruction,
            ee_pose=pose,
            gripper_open=float(view["opening"]),
            stamp_ns=frame.stamp_ns,
        )


def judge_files(paths: Sequence[Path], weights: MonitorWeights) -> list[JudgedEpisode]:
    """Show all episodes of some files to the monitor. An episode of the kind `success` in which the
    cube was not held, and a failing one in which it was (but the frozen camera's), is left out: its
    kind is not what happened.
    """
    judged = []
    for path in paths:
        recording = read_episode(path)
        succeeded = recording.succeeded_s is not None
        if recording.kind != "frozen" and succeeded != (recording.kind == SUCCESS):
            continue
        judged.append(judge_episode(recording, weights))
    return judged


def write_judged(path: Path, judged: Sequence[JudgedEpisode]) -> None:
    """Write one line of JSON for each episode."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [json.dumps(asdict(each)) for each in judged]
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def table(judged: Sequence[JudgedEpisode]) -> str:
    """The figures by kind, as a Markdown table."""
    head = "| episodes | cases | false success | 95 % upper bound | noticed | median, 95 % time |"
    lines = [head, "|---|---|---|---|---|---|"]
    failing = [each for each in judged if not each.is_success]
    for kind in (*(kind for kind in KINDS if kind != SUCCESS), "all failing"):
        cases = failing if kind == "all failing" else [e for e in failing if e.kind == kind]
        if not cases:
            continue
        wrong = sum(each.is_false_claim for each in cases)
        times = [each.noticed_s for each in cases if each.noticed_s is not None]
        bound = f"{100 * upper_bound(wrong, len(cases)):.2f} %"
        lines.append(
            f"| {kind} | {len(cases)} | {wrong} | {bound} | {len(times)} | {_times(times)} |"
        )
    return "\n".join(lines)


def summary(judged: Sequence[JudgedEpisode]) -> dict[str, float | int | None]:
    """Figures over all episodes."""
    good = [each for each in judged if each.is_success]
    bad = [each for each in judged if not each.is_success]
    claimed = [each.claimed_s for each in good if each.claimed_s is not None]
    wrong = sum(each.is_false_claim for each in bad)
    return {
        "successes": len(good),
        "found": len(claimed),
        "found_s_median": float(np.median(claimed)) if claimed else None,
        "found_s_95": float(np.quantile(claimed, 0.95)) if claimed else None,
        "false_alarms": sum(each.is_false_alarm for each in good),
        "early_claims": sum(each.is_false_claim for each in good),
        "failures": len(bad),
        "false_successes": wrong,
        "false_success_upper_95": upper_bound(wrong, len(bad)),
        "area_success": area([e.success for e in good], [e.success for e in bad])
        if good and bad
        else None,
        "area_failure": area([e.failure for e in bad], [e.failure for e in good])
        if good and bad
        else None,
    }


def _times(times: Sequence[float]) -> str:
    if not times:
        return "-"
    return f"{np.median(times):.1f} s, {np.quantile(times, 0.95):.1f} s"
