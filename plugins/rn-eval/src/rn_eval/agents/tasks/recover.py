"""Continue after a fault: a killed module, a frozen camera, a slipping grasp."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar, Literal

from rn_eval.agents.client import ToolClient
from rn_eval.agents.conduct import Conduct
from rn_eval.agents.task import AgentScene, AgentVerdict, InjectedFault, Module
from rn_eval.agents.tasks.base import CubeTask, Difficulty, draw_target, lifted_alone
from rn_eval.agents.tasks.place import is_put
from rn_eval.agents.tasks.scenes import is_free
from rn_eval.agents.tasks.steps import (
    DONE,
    hold_up,
    lift_whatever_happens,
    lift_with,
    put_whatever_happens,
)
from rn_eval.agents.truth import Truth
from rn_simulation.cubes import Cube


class _Recover(CubeTask):
    """Pick up a cube while a module fails on the way."""

    module: ClassVar[Module] = "control"
    kind: ClassVar[Literal["kill", "freeze"]] = "kill"
    difficulty: ClassVar[Difficulty] = 3
    time_limit_s = 120.0
    wordings: ClassVar[tuple[str, ...]] = (
        "Pick up the {colour} cube. If something fails on the way, put it right and go on.",
        "Lift the {colour} cube, whatever happens: when a part of the system breaks, see to it "
        "that it runs again, and finish the job.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """The module fails 1 to 2.5 s after the first run_task."""
        chance, colours, target = draw_target(type(self).__name__, seed)
        fault = InjectedFault(
            module=self.module, kind=self.kind, delay_s=round(chance.uniform(1.0, 2.5), 2)
        )
        return replace(self.scene(seed, colours, facts={"target": target}), fault=fault)

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The cube must be in the air at the end."""
        return AgentVerdict.of(*lifted_alone(truth, scene.text("target")))

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Retry, and restart modules that have ended."""
        await lift_whatever_happens(tools, scene.text("target"))
        return DONE


class KilledControl(_Recover):
    """The controller is killed."""


class KilledInference(_Recover):
    """The policy is killed."""

    module = "inference"


class KilledPerception(_Recover):
    """The cameras are killed."""

    module = "perception"


class KilledRobot(_Recover):
    """The simulation is killed, and loses the cube in the hand."""

    module = "robot"


class FrozenCameras(_Recover):
    """The cameras freeze."""

    module = "perception"
    kind = "freeze"


class WrongPolicy(_Recover):
    """The configured policy never moves; nothing else is faulty."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Pick up the {colour} cube. If the policy that is configured does nothing, use another one "
        "that needs no model.",
        "Lift the {colour} cube. The configured policy may be the wrong one: then find one that "
        "needs no weights and finish the job with it.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """A scene without a fault, but with the policy `noop`."""
        scene = super().prepare(seed)
        return replace(scene, fault=None, backend="noop")

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Use the policy that works."""
        await lift_with(tools, "servo", scene.text("target"))
        return DONE


class FrozenPolicy(_Recover):
    """The policy freezes."""

    module = "inference"
    kind = "freeze"


class DroppedWhileHeld(CubeTask):
    """Hold up a cube that slips once from the hand."""

    difficulty: ClassVar[Difficulty] = 3
    time_limit_s = 120.0
    wordings: ClassVar[tuple[str, ...]] = (
        "Pick up the {colour} cube and hold it up for {seconds} seconds without a break. It is "
        "slippery: look whether the hand still holds it, and pick it up again if it has fallen.",
        "Hold the {colour} cube in the air for {seconds} seconds. Should it slip out of the hand, "
        "lift it again and begin anew.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """The cube slips 2 to 4 s after it was lifted."""
        chance, colours, target = draw_target(type(self).__name__, seed)
        seconds = chance.choice((6, 8))
        return replace(
            self.scene(seed, colours, facts={"target": target, "seconds": seconds}),
            slip_after_s=round(chance.uniform(2.0, 4.0), 2),
        )

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The cube must have been in the air for the required time at the end."""
        target = scene.text("target")
        held_s = truth.lifted_at_end_s(target)
        return AgentVerdict.of(
            *lifted_alone(truth, target),
            (
                held_s >= scene.number("seconds"),
                f"The {target} cube was in the air for {held_s:.1f} s only.",
            ),
        )

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Check every second whether it is held, with the call that also picks it up again."""
        await hold_up(tools, scene.text("target"), scene.number("seconds"))
        return DONE


class DroppedOnTheWay(CubeTask):
    """Place a cube that slips once while it is carried."""

    difficulty: ClassVar[Difficulty] = 3
    time_limit_s = 150.0
    wordings: ClassVar[tuple[str, ...]] = (
        "Put the {colour} cube down at x = {x_m} m, y = {y_m} m of the robot's base frame. If it "
        "falls on the way, pick it up again and bring it there.",
        "Set the {colour} block onto the table at ({x_m}, {y_m}), metres in the base frame. It may "
        "slip out of the hand; then try again.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """The cube slips 1.5 to 2.5 s after it was lifted."""
        chance, colours, target = draw_target(type(self).__name__, seed)
        x_m, y_m = round(chance.uniform(0.42, 0.58), 2), round(chance.uniform(-0.25, 0.25), 2)

        def has_room(cubes: Mapping[str, Cube]) -> bool:
            return is_free(cubes, target, x_m, y_m)

        return replace(
            self.scene(seed, colours, has_room, facts={"target": target, "x_m": x_m, "y_m": y_m}),
            slip_after_s=round(chance.uniform(1.5, 2.5), 2),
        )

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The cube must lie at the position. Other cubes may have moved, because it may fall onto
        them.
        """
        return is_put(truth, scene.text("target"), scene.number("x_m"), scene.number("y_m"))

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Pick and place the cube until it is there."""
        await put_whatever_happens(
            tools, scene.text("target"), scene.number("x_m"), scene.number("y_m")
        )
        return DONE
