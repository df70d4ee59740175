"""Joint motions permitted by the gate bring no link of the FR3 into another one or the table, as
checked by PyBullet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from link_contacts import penetrations

from rn_robot_fr3.limits import FINGER_OPEN_M
from rn_robot_fr3.profile import HOME_RAD
from rn_robot_fr3.simulation import ArmSimulation
from rn_robot_fr3.world import JOINTS
from roboneuron.config import parse_config
from roboneuron.contract import JointCommand, JointSample
from roboneuron.direct_path.exposed import allowed_endpoint, profile_endpoints
from roboneuron.direct_path.gate import Gate
from roboneuron.errors import RefusedError
from roboneuron.estop import EmergencyStopLatch
from roboneuron.feature import GateRequest
from roboneuron.gate import AuditLog
from roboneuron.modules.arm_paths import ArmPaths
from roboneuron.modules.plugin import load_profile
from roboneuron.plugins.discovery import discover
from roboneuron.ros.messages import to_joint_trajectory

COMMANDED = JOINTS[:8]
HOME = np.array([*HOME_RAD, FINGER_OPEN_M])
Ask = Callable[..., str]


@pytest.fixture
def make_ask(tmp_path: Path) -> Callable[..., Ask]:
    """Return a function that makes a judge of one joint move; it returns the reason of a refusal,
    or nothing.
    """

    def make(limits: str = "", workspace: bool = False) -> Ask:
        config = parse_config(
            f'[robot]\nname = "fr3"\n[control]\ncontroller = "urdf"\n[limits]\n{limits}'
        )
        registry = discover(())
        paths = ArmPaths(config, lambda: registry)
        offered = profile_endpoints("fr3", config.namespace, load_profile(registry, "fr3"))
        exposed = next(e for e in offered if e.label == "joint_trajectory")
        assert exposed.profile is not None
        free = exposed.profile if workspace else replace(exposed.profile, workspace=None)
        entry = replace(
            allowed_endpoint(exposed),
            rules=paths.rules("fr3", free),
            path=lambda: paths.limiter("fr3", free),
        )
        entry = replace(entry, endpoint=replace(entry.endpoint, rate_hz=0.0))
        latch = EmergencyStopLatch(tmp_path / "stop", lambda: 0)
        gate = Gate(
            [entry], latch=latch, audit=AuditLog(tmp_path / "audit", lambda: 0), clock=lambda: 0.0
        )

        def ask(
            start: np.ndarray, target: np.ndarray, duration_s: float = 60.0, simulated: bool = False
        ) -> str:
            command = JointCommand(names=COMMANDED, position=target, duration_s=duration_s)
            request = GateRequest(
                who="agent",
                role="operator",
                tool="move_joints",
                robot="fr3",
                endpoint="joint_trajectory",
                messages=(to_joint_trajectory(command),),
                simulated=simulated,
                joints=JointSample(names=JOINTS, position=np.append(start, start[-1])),
            )
            try:
                return gate.check(request).reason
            except RefusedError as error:
                return str(error)

        return ask

    return make


@pytest.fixture
def simulation() -> Iterator[ArmSimulation]:
    """The simulated FR3, with its cubes moved away."""
    with ArmSimulation(0, colours=("red",)) as made:
        made.world.set_cubes(
            dict.fromkeys(made.world.cube_poses(), ((0.0, 5.0, 0.5), (0.0, 0.0, 0.0, 1.0)))
        )
        yield made


def along(
    simulation: ArmSimulation, start: np.ndarray, target: np.ndarray, count: int
) -> list[tuple[str, str, float]]:
    """Penetrations at postures on the straight path."""
    found = []
    for share in np.linspace(0.0, 1.0, count):
        position = start + (target - start) * share
        simulation.world.set_joints([*position, position[-1]])
        found += penetrations(simulation)
    return found


BASE_AND_LINK6 = np.array([0.0, -0.606, -2.803, -2.798, 1.529, 1.032, 0.785, 0.04])
"""A posture within all joint limits."""


def test_move_joints_does_not_press_link_6_into_the_base(
    make_ask: Any, simulation: ArmSimulation
) -> None:
    assert ("fr3_link0", "fr3_link6") in {
        found[:2] for found in along(simulation, BASE_AND_LINK6, BASE_AND_LINK6, 1)
    }
    reason = make_ask()(HOME, BASE_AND_LINK6)
    assert "mm apart, at least 10 mm are required" in reason
    alone = make_ask()(BASE_AND_LINK6 + np.array([0, -0.2, 0, 0, 0, 0, 0, 0]), BASE_AND_LINK6)
    assert alone.startswith("fr3_link0 and fr3_link6 would be ")
    assert make_ask()(HOME, BASE_AND_LINK6, simulated=True) == reason
    assert make_ask("collision = false")(HOME, BASE_AND_LINK6) == ""


def test_tilting_the_hand_at_low_height_does_not_press_a_link_onto_the_table(
    make_ask: Any, simulation: ArmSimulation
) -> None:
    """TCP 27 mm above the table; joint 6 tilts the hand over the fingertips until its flange
    approaches the table.
    """
    low = np.array([0.0, 0.2, 0.0, -2.42, 0.0, 2.62, 0.785, 0.04])
    tilted = low + np.array([0.0, 0.52, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    assert any(name == "table" for _, name, _ in along(simulation, tilted, tilted, 1))
    assert "and table would be" in make_ask()(HOME, tilted)
    assert make_ask("collision = false")(HOME, tilted) == ""


def test_ways_out_of_a_penetration_are_allowed(make_ask: Any) -> None:
    away = BASE_AND_LINK6 + np.array([0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0])
    assert make_ask()(BASE_AND_LINK6, away) == ""


def test_fingers_may_work_just_above_the_table(make_ask: Any) -> None:
    """At the lowest TCP of the workspace, the hand straight down: fingertips 1 mm above the
    table.
    """
    from rn_controller_urdf.controller import UrdfController
    from rn_robot_fr3.profile import profile
    from roboneuron.contract import Action

    controller = UrdfController(None, profile())
    controller.load()
    posture = HOME[:7].copy()
    for _ in range(200):
        tcp = controller.forward(JointSample(names=JOINTS[:7], position=posture)).position_m
        step = np.clip(np.array([0.45, 0.0, 0.0105]) - tcp, -0.02, 0.02)
        if np.linalg.norm(step) < 1e-5:
            break
        action = Action(translation_m=step, rotation_rad=np.zeros(3), gripper_open=1.0)
        command = controller.compute(action, JointSample(names=JOINTS[:7], position=posture), 0.1)
        assert isinstance(command, JointCommand), command
        posture = command.position[:7]
    assert make_ask()(HOME, np.append(posture, 0.04)) == ""
    assert "finger and table would be" in make_ask()(
        HOME, np.append(posture + np.eye(7)[3] * -0.01, 0.04)
    )


def _targets(rng: np.random.Generator, count: int) -> Sequence[np.ndarray]:
    from rn_robot_fr3.profile import profile

    limits = profile().limits
    assert limits is not None
    lower, upper = np.append(limits.lower, 0.0), np.append(limits.upper, FINGER_OPEN_M)
    return list(rng.uniform(lower, upper, (count, 8)))


@pytest.mark.parametrize(
    "count",
    [
        12,
        pytest.param(30, marks=pytest.mark.exhaustive),
        pytest.param(100, marks=pytest.mark.slow),
    ],
)
def test_no_permitted_motion_penetrates_anything_on_its_way(
    make_ask: Any, simulation: ArmSimulation, count: int
) -> None:
    """Random targets over the whole joint space, half of them continued from the end of the last
    permitted motion.
    """
    ask, rng = make_ask(), np.random.default_rng(7)
    start, permitted, refused = HOME, 0, 0
    for target in _targets(rng, count):
        near = start + (target - start) * rng.choice([0.2, 1.0])
        if ask(start, near):
            refused += 1
            continue
        permitted += 1
        assert along(simulation, start, near, 25) == []
        start = near
    assert permitted > 0.6 * count
    assert refused > 0.1 * count


@pytest.mark.parametrize(
    "count",
    [
        5,
        pytest.param(12, marks=pytest.mark.exhaustive),
        pytest.param(40, marks=pytest.mark.slow),
    ],
)
def test_no_permitted_motion_penetrates_anything_while_it_is_carried_out(
    make_ask: Any, simulation: ArmSimulation, count: int
) -> None:
    """The same with the simulator's motors, as fast as the gate allows: joints do not start all
    alike.
    """
    ask, rng = make_ask("max_speed_m_s = 0.5"), np.random.default_rng(11)
    start, moves = HOME, 0
    for target in _targets(rng, count):
        near = start + (target - start) * rng.choice([0.4, 1.0])
        duration_s = next((d for d in (1.0, 2.0, 4.0, 8.0) if not ask(start, near, d)), None)
        if duration_s is None:
            continue
        moves += 1
        simulation.set_target(COMMANDED, near, duration_s)
        for _ in range(int((duration_s + 0.3) * 240 / 12)):
            simulation.step(12)
            assert penetrations(simulation) == []
        start = simulation.joint_positions()[:8]
    assert moves > 0.35 * count
