"""Record the robot's motion, and report the file."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from rn_eval.agents.conduct import Conduct
from rn_eval.agents.task import AgentScene, AgentVerdict
from rn_eval.agents.tasks.base import CubeTask, Difficulty, draw_target
from rn_eval.agents.truth import Truth


class _RecordTask(CubeTask):
    """A recording must exist, and the answer must name it."""

    difficulty: ClassVar[Difficulty] = 2
    form = "<path of the recorded file>"

    def recorded(self, conduct: Conduct) -> tuple[tuple[bool, str], ...]:
        """Demands on the recording."""
        name = conduct.answer.rpartition("/")[2]
        folder = conduct.answer.rstrip("/").rpartition("/")[2]
        files = [f"/{path.lower()}" for path in conduct.files]
        found = any(
            path.endswith(f"/{name}") or (folder != "" and f"/{folder}/" in path) for path in files
        )
        return (
            (bool(conduct.files), "Nothing was recorded."),
            (bool(conduct.answer) and found, f"{conduct.answer[:80]!r} is no recorded file."),
            (conduct.called("stop_recording"), "The recording was not ended."),
        )


class Move(_RecordTask):
    """Record a move."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Record while you move the hand 10 cm up, then end the recording and tell me where the "
        "file is.",
        "Make a recording of the hand moving 10 cm upwards; give me the path of the file.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """The recorder runs."""
        return replace(self.scene(seed), records=True)

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """Judge the file and the move."""
        if truth.is_empty:
            return AgentVerdict(success=False, reason="The robot was never started.")
        up_m = float(truth.tcp_m[-1, 2] - truth.tcp_m[truth.starts[-1], 2])
        return AgentVerdict.of(
            *self.recorded(conduct),
            (abs(up_m - 0.1) <= 0.01, f"The hand has moved up by {100 * up_m:.0f} cm."),
        )


class Pick(_RecordTask):
    """Record the picking of a cube."""

    difficulty: ClassVar[Difficulty] = 3
    time_limit_s = 90.0
    wordings: ClassVar[tuple[str, ...]] = (
        "Record how you pick up the {colour} cube, and give me the path of the recorded file.",
        "Lift the {colour} cube with the recorder running; end the recording and name the file.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """The recorder runs."""
        _, colours, target = draw_target("record-pick", seed)
        return replace(self.scene(seed, colours, facts={"target": target}), records=True)

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """Judge the file and the cube."""
        target = scene.text("target")
        return AgentVerdict.of(
            *self.recorded(conduct),
            (truth.is_lifted(target), f"The {target} cube is not in the air at the end."),
        )
