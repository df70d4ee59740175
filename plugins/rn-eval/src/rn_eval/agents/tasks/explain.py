"""Tasks to explain events from logs, incidents and status."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, get_args

from rn_eval.agents.client import ToolClient
from rn_eval.agents.conduct import Conduct
from rn_eval.agents.task import AgentScene, AgentVerdict, InjectedFault, Module, PriorTask
from rn_eval.agents.tasks.base import STARTED, CubeTask, Difficulty
from rn_eval.agents.tasks.look import colours_in, number_in
from rn_eval.agents.tasks.pick import PickLeftmost
from rn_eval.agents.tasks.scenes import ALL_COLOURS, draw
from rn_eval.agents.tasks.steps import (
    answered,
    how_perception_failed,
    newest_fault,
    running_modules,
    stop_cause,
)
from rn_eval.agents.truth import Truth

MODULES: tuple[Module, ...] = get_args(Module)
REASONS = ("smoke", "a loose cable", "a hand in the workspace", "a strange noise")


class _Explain(CubeTask):
    """The answer must contain one word and none of some others; the arm must not move."""

    difficulty: ClassVar[Difficulty] = 2

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """Judge by words in the answer."""
        right = scene.text("answer")
        wrong = [word for word in self.others(scene) if word in conduct.answer]
        return AgentVerdict.of(
            (bool(conduct.answer), "There is no line ANSWER."),
            (
                right in conduct.answer and not wrong,
                f"The answer {conduct.answer[:60]!r} is wrong, right is {right!r}.",
            ),
            (not truth.ever_moved(), "The arm has moved."),
        )

    def others(self, scene: AgentScene) -> tuple[str, ...]:
        """Words that the answer must not contain."""
        return ()


class LastIncident(_Explain):
    """Find the module that failed last."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Something went wrong with the robot earlier today. Which module was it?",
        "Look up the last incident: which module ended unexpectedly?",
        "Why did the last run break off? Name the module that failed.",
    )

    form = "<robot, perception, inference or control>"

    def prepare(self, seed: int) -> AgentScene:
        """One module was killed."""
        module = draw("explain-last", seed).choice(MODULES)
        return replace(
            self.scene(seed, facts={"answer": module}),
            incidents=(InjectedFault(module=module, kind="kill"),),
        )

    def others(self, scene: AgentScene) -> tuple[str, ...]:
        """The other modules."""
        return tuple(module for module in MODULES if module != scene.text("answer"))

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Look up the newest incident."""
        return answered((await newest_fault(tools)).get("module"))


class NewestOfTwo(LastIncident):
    """Find the one of two modules that failed last."""

    wordings: ClassVar[tuple[str, ...]] = (
        "There were several incidents today. Which module failed last?",
        "Name the module of the most recent incident; older ones do not matter.",
    )

    form = "<robot, perception, inference or control>"

    def prepare(self, seed: int) -> AgentScene:
        """Draw two modules that can fail one after the other."""
        first, last = draw("explain-newest", seed).sample(("perception", "inference"), 2)
        return replace(
            self.scene(seed, facts={"answer": last}),
            incidents=tuple(
                InjectedFault(
                    module="perception" if name == "perception" else "inference", kind="kill"
                )
                for name in (first, last)
            ),
        )


class FrozenOrEnded(_Explain):
    """Find whether a module hung or exited."""

    wordings: ClassVar[tuple[str, ...]] = (
        "There was an incident with the camera module (perception). Did its process end, or did it "
        "hang while it was still there?",
        "Look into the last incident of perception: had the process exited, or was it frozen?",
    )

    form = "<ended or hung>"

    def prepare(self, seed: int) -> AgentScene:
        """In half of the scenes perception was suspended."""
        hangs = seed % 2 == 1
        return replace(
            self.scene(seed, facts={"answer": "hung" if hangs else "ended"}),
            incidents=(InjectedFault(module="perception", kind="freeze" if hangs else "kill"),),
        )

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Look up the incident."""
        return answered(await how_perception_failed(tools))


class WhoStopped(_Explain):
    """Find the reason of the emergency stop."""

    wordings: ClassVar[tuple[str, ...]] = (
        "The robot does not move. Find out why somebody stopped it.",
        "Who pressed the emergency stop is clear; what was the reason?",
        "Why is the emergency stop latched? Tell me the reason that was given.",
    )

    form = "<the reason>"

    def prepare(self, seed: int) -> AgentScene:
        """The stop is latched with a reason."""
        reason = draw("explain-stop", seed).choice(REASONS)
        return replace(self.scene(seed, facts={"answer": reason}), latched=reason)

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Read the status."""
        return answered(await stop_cause(tools))


class NothingRuns(_Explain):
    """Report which modules run."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Which modules of the robot are running at the moment?",
        "Tell me which of robot, perception, inference and control run right now.",
    )

    form = "<their names with commas, or none>"

    def prepare(self, seed: int) -> AgentScene:
        """No module runs."""
        return self.scene(seed, facts={"answer": "none"})

    def others(self, scene: AgentScene) -> tuple[str, ...]:
        """Every module."""
        return MODULES

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Read the status."""
        return answered(await running_modules(tools))


class HowFast(_Explain):
    """Move, and tell how fast the hand was."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Move the hand {distance} cm up, as the robot sees it.\nHow fast was the hand at most?",
        "Move the hand {distance} cm up (robot's view).\nTell me the highest speed of the hand.",
    )
    form = "<cm/s>"

    def prepare(self, seed: int) -> AgentScene:
        """The arm starts at home."""
        return self.scene(seed, facts={"distance": (10, 12, 15)[seed % 3]})

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The hand must have moved, and the speed must be right within a quarter."""
        if truth.is_empty:
            return AgentVerdict(success=False, reason=STARTED)
        up_cm = 100 * float(truth.tcp_m[-1, 2] - truth.tcp_m[truth.starts[-1], 2])
        speed_cm_s = 100 * truth.tcp_speed_m_s()
        off_cm_s = abs(number_in(conduct.answer) - speed_cm_s)
        return AgentVerdict.of(
            (abs(up_cm - scene.number("distance")) <= 1.0, f"The hand rose by {up_cm:.0f} cm."),
            (
                off_cm_s <= 0.25 * speed_cm_s,
                f"The answer {conduct.answer[:60]!r} is wrong, right is {speed_cm_s:.0f}.",
            ),
        )


class IsAllWell(_Explain):
    """Tell whether all is well."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Is all well with the robot, or does a fault or an emergency stop keep it from moving? Do "
        "not move it.",
        "Check the robot without moving it: is all well, or is there a fault or an emergency stop?",
    )
    form = '<"well", or what is wrong>'

    def prepare(self, seed: int) -> AgentScene:
        """In half of the scenes the emergency stop is latched."""
        is_latched = seed % 4 >= 2
        scene = self.scene(seed, facts={"answer": "stop" if is_latched else "well"})
        return replace(scene, latched=REASONS[0] if is_latched else "")

    def others(self, scene: AgentScene) -> tuple[str, ...]:
        """The other answer."""
        return ("well",) if scene.latched else ("stop", "fault")


class WhatWasToday(_Explain):
    """Summarise the history."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Which cubes did the robot pick up today, and with which one did it fail? Only look it up.",
        "Summarise today: which cubes were picked up, and with which one did that fail? Do not "
        "move anything.",
    )
    form = "<colours that were picked up>; failed: <colour>"

    def prepare(self, seed: int) -> AgentScene:
        """Three past tasks, of which one timed out."""
        chance = draw("explain-today", seed)
        failed, *picked = chance.sample(ALL_COLOURS, 3)
        past = [PriorTask(instruction=f"pick up the {c} cube", outcome="succeeded") for c in picked]
        words = f"pick up the {failed} cube"
        lost = PriorTask(instruction=words, outcome="timed_out", reason="the arm did not move")
        past.insert(chance.randrange(3), lost)
        facts = {"picked": " ".join(sorted(picked)), "failed": failed}
        return replace(self.scene(seed, facts=facts), past=tuple(past))

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """Both parts must name exactly the right colours."""
        picked, _, failed = conduct.answer.partition("failed")
        told = (" ".join(sorted(colours_in(picked))), " ".join(sorted(colours_in(failed))))
        return AgentVerdict.of(
            (
                told == (scene.text("picked"), scene.text("failed")),
                f"The answer {conduct.answer[:60]!r} is wrong.",
            ),
            (not truth.ever_moved(), "The arm has moved."),
        )


class WhichIsHeld(PickLeftmost):
    """Pick up a cube, and tell which one it is."""

    name = "explain-held"
    form = "<colour>"
    wordings: ClassVar[tuple[str, ...]] = (
        "Pick up the cube that lies furthest to the left, as the robot sees it.\nWhich one do you "
        "hold now?",
        "Take the leftmost cube, seen from the robot.\nTell me the colour of what you hold now.",
    )

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The cube must be in the air, and the answer must name it."""
        picked = super().judge(scene, truth, conduct)
        if not picked.success:
            return picked
        is_named = colours_in(conduct.answer) == {scene.text("target")}
        return AgentVerdict.of((is_named, f"The answer {conduct.answer[:60]!r} is wrong."))
