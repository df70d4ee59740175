"""Joint commands from a foreign node, alone and beside a working policy, judged by the simulated
FR3's joints, and by the distances of its links in another program than the controller.
"""

from __future__ import annotations

import contextlib
import math
import random
import time
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any

import numpy as np
import pytest
from link_contacts import penetrations
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from rn_controller_urdf.controller import UrdfController
from rn_robot_fr3.limits import (
    ARM_JOINTS,
    FINGER_JOINT,
    FINGER_OPEN_M,
    LOWER_RAD,
    UPPER_RAD,
    VELOCITY_RAD_S,
)
from rn_robot_fr3.profile import HOME_RAD, profile
from rn_robot_fr3.simulation import ArmSimulation
from rn_testing.waiting import wait_until
from roboneuron.contract import JointSample

pytestmark = [pytest.mark.ros]

Wait = Callable[[Callable[[], bool], float, str], float]
SHARE = 0.25
"""Of the joints' velocities, in [limits]; the simulated driver itself allows four times as much."""
WINDOW_S = 0.5
"""Joints are as fast as a command says on average: they have to gain and lose their speed within
its time."""
LAG_RAD = 0.05
PAUSE_S = 0.3
ASIDE_M, WAVE_M = 0.03, 0.25
"""Of a wave: how far it leads aside, and along y, six times 20 mm to and fro."""
LEAST_M = 0.005
"""Of the 10 mm between links, or to the table; the arm brakes where the next command is refused."""
REASONS = {
    "not_finite",
    "limit_position",
    "joint_jump",
    "unknown_joint",
    "malformed_command",
    "stale_command",
    "future_command",
    "limit_collision",
    "limit_zone",
}
ZONE_M = np.array([[-0.2, 0.15, 0.0], [0.8, 0.6, 1.0]])
"""At the left of the arm."""
LIMITS = f"""
[limits]
velocity_fraction = {SHARE}
[[limits.zones]]
name = "left"
lower_m = {ZONE_M[0].tolist()}
upper_m = {ZONE_M[1].tolist()}
"""
HOME = np.array(HOME_RAD)
TABLE = np.add(HOME, [0.0, 1.8, 0.0, 0.6, 0.0, 0.0, 0.0])
LEFT = np.add(HOME, [1.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


Command = JointTrajectory | JointState
LOWER, UPPER = np.array(LOWER_RAD), np.array(UPPER_RAD)


class HostileCommands:
    """Draws commands; the same seed draws the same ones.

    Args:
        seed: of the random numbers.
        place: returns the measured joints (7,) [rad].
    """

    def __init__(self, seed: int, place: Callable[[], np.ndarray]) -> None:
        self._random, self._place = random.Random(seed), place
        self.kinds: dict[str, Callable[[], Command]] = {
            "nan": lambda: self.timed(self._spoilt(math.nan)),
            "infinite": lambda: self.timed(self._spoilt(self._sign() * math.inf)),
            "huge": lambda: self.timed(self._spoilt(self._sign() * 10.0 ** self._from(5, 308))),
            "beyond": lambda: self.timed(self._beyond(), self._from(0.01, 30.0)),
            "jump": lambda: self.timed(self._anywhere(), self._from(0.001, 0.3)),
            "fast": lambda: self.timed(self._near(self._from(0.0, 0.3)), self._from(0.001, 0.2)),
            "nervous": lambda: self.timed(self._near(2.0), self._from(0.5, 2.0)),
            "slow": lambda: self.timed(self._anywhere(), self._from(3.0, 20.0)),
            "table": lambda: self.timed(TABLE, self._from(4.0, 8.0)),
            "left": lambda: self.timed(LEFT, self._from(3.0, 8.0)),
            "state": lambda: self._state(self._near(self._from(0.0, 0.5))),
            "state anywhere": lambda: self._state(self._anywhere()),
            "path": self._path,
            "other names": self._renamed,
            "other order": self._shuffled,
            "one joint": self._one_joint,
            "finger": self._finger,
            "times": self._mistimed,
            "stamped": self._stamped,
            "long": lambda: self.points([self._near(0.02) for _ in range(2100)], 0.01),
        }

    def __iter__(self) -> Iterator[tuple[str, Command]]:
        names = [name for name in self.kinds if name != "long"]
        while True:
            name = "long" if self._random.random() < 0.002 else self._random.choice(names)
            yield name, self.kinds[name]()

    def _from(self, low: float, high: float) -> float:
        return self._random.uniform(low, high)

    def _sign(self) -> float:
        return self._random.choice([-1.0, 1.0])

    def _anywhere(self) -> np.ndarray:
        return np.array([self._from(a, b) for a, b in zip(LOWER, UPPER, strict=True)])

    def _near(self, farthest: float) -> np.ndarray:
        place = self._place() + [self._from(-farthest, farthest) for _ in ARM_JOINTS]
        return np.asarray(np.clip(place, LOWER, UPPER))

    def _spoilt(self, value: float) -> np.ndarray:
        place = self._near(0.02)
        place[self._random.randrange(7)] = value
        return place

    def _beyond(self) -> np.ndarray:
        place, joint = self._near(0.02), self._random.randrange(7)
        out = self._random.choice([1e-4, 0.01, 0.3, 3.0])
        place[joint] = self._random.choice([LOWER[joint] - out, UPPER[joint] + out])
        return place

    def timed(self, place: np.ndarray, duration_s: float = 0.1) -> JointTrajectory:
        return self.points([place], duration_s)

    def points(self, places: list[np.ndarray], step_s: float) -> JointTrajectory:
        message = JointTrajectory(joint_names=list(ARM_JOINTS))
        for index, place in enumerate(places):
            point = JointTrajectoryPoint(positions=place.tolist())
            at_ns = round((index + 1) * step_s * 1e9)
            point.time_from_start.sec, point.time_from_start.nanosec = divmod(at_ns, 10**9)
            message.points.append(point)
        return message

    def _state(self, place: np.ndarray) -> JointState:
        return JointState(name=list(ARM_JOINTS), position=place.tolist())

    def _path(self) -> JointTrajectory:
        """A path to anywhere, in steps of any length."""
        here, there = self._place(), self._anywhere()
        count = self._random.randint(2, 50)
        places = [here + (there - here) * k / count for k in range(1, count + 1)]
        return self.points(places, self._from(0.002, 0.2))

    def _renamed(self) -> JointTrajectory:
        message = self.timed(self._near(0.02))
        name = self._random.choice(
            ["", "joint1", "fr3_joint8", "fr3_joint1", "x" * 5000, "é\x1b[2J"]
        )
        message.joint_names[self._random.randrange(1, 7)] = name
        return message

    def _shuffled(self) -> JointTrajectory:
        place, order = self._near(0.2), self._random.sample(range(7), 7)
        message = self.timed(place[order], self._from(0.05, 0.5))
        message.joint_names = [ARM_JOINTS[i] for i in order]
        return message

    def _one_joint(self) -> JointTrajectory:
        joint = self._random.randrange(7)
        message = self.timed(self._anywhere()[joint : joint + 1], self._from(0.01, 5.0))
        message.joint_names = [ARM_JOINTS[joint]]
        return message

    def _finger(self) -> JointTrajectory:
        place = np.array([self._random.choice([-0.01, 0.0, 0.02, 0.04, 0.05, 1.0])])
        message = self.timed(place)
        message.joint_names = [FINGER_JOINT]
        return message

    def _mistimed(self) -> JointTrajectory:
        message = self.points([self._near(0.02) for _ in range(3)], 0.1)
        point = self._random.choice(message.points)
        point.time_from_start.sec = self._random.choice([-(2**31), -1, 0, 2**31 - 1])
        return message

    def _stamped(self) -> JointTrajectory:
        message = self.timed(self._near(0.3), 0.5)
        away_s = self._random.choice([-1e6, -10.0, -1.0, 1.0, 10.0, 1e6])
        message.header.stamp.sec = int(time.time() + away_s)
        return message


def publishers_on(node: Any) -> Callable[[Command], None]:
    """Return a function that publishes a command of either type."""
    state = node.create_publisher(JointState, "joint_command", 10)
    timed = node.create_publisher(JointTrajectory, "joint_trajectory", 10)
    for publisher in (state, timed):
        wait_until(
            lambda one=publisher: one.get_subscription_count() > 0, 10.0, "the robot listens"
        )
    return lambda message: (state if isinstance(message, JointState) else timed).publish(message)


def bombard(arm: Any, count: int, seed: int) -> Counter[str]:
    """Publish hostile commands about 300 times a second; return their number by kind.

    Now and then the arm has time to follow a command that is much too fast.
    """
    publish = publishers_on(arm.node)
    commands = HostileCommands(seed, lambda: arm.states[-1][1])
    sent: Counter[str] = Counter()
    every = max(20, count // 50)
    for index, (name, message) in enumerate(islice(commands, count)):
        if index % every == 0:
            name = ("fast", "jump", "state", "state anywhere")[index // every % 4]
            message = commands.kinds[name]()
        publish(message)
        sent[name] += 1
        time.sleep(PAUSE_S if index % every == 0 else 0.003)
    return sent


def check_motion(arm: Any, since_s: float) -> None:
    """Check every joint's positions, its speed at once and on average, and where the arm was."""
    states = [state for state in list(arm.states) if state[0] >= since_s]
    times = np.array([at_s for at_s, _, _ in states])
    positions = np.array([position for _, position, _ in states])
    velocities = np.array([velocity for _, _, velocity in states])
    limit = np.array(VELOCITY_RAD_S)
    assert np.isfinite(positions).all()
    assert (positions >= LOWER - 1e-3).all()
    assert (positions <= UPPER + 1e-3).all()
    # the simulated motors overshoot their setpoint a little (2 % in the driver's own test)
    assert (np.abs(velocities) <= limit * 1.02).all()
    later = np.searchsorted(times, times + WINDOW_S)
    whole = later < len(times)
    moved = np.abs(positions[later[whole]] - positions[whole])
    passed_s = (times[later[whole]] - times[whole])[:, None]
    assert (moved <= SHARE * limit * passed_s * 1.02 + LAG_RAD).all(), moved.max(axis=0)
    check_places(positions)


def check_places(positions: np.ndarray) -> None:
    """Check that no posture (k, 7) has links too near to each other or to the table, nor its TCP in
    the zone; a hundred of them, because each takes 10 ms.
    """
    controller = UrdfController(None, profile())
    controller.load()
    with ArmSimulation(0, colours=("red",)) as simulation:
        for position in positions[:: max(1, len(positions) // 100)]:
            simulation.world.set_joints([*position, FINGER_OPEN_M, FINGER_OPEN_M])
            assert penetrations(simulation, LEAST_M) == []
            tcp_m = controller.forward(JointSample(names=ARM_JOINTS, position=position)).position_m
            inside = np.minimum(tcp_m - ZONE_M[0], ZONE_M[1] - tcp_m).min()
            assert inside < LEAST_M, f"the TCP is {inside:.4f} m deep in the zone"


@pytest.fixture(
    scope="module", params=["pybullet", pytest.param("mujoco", marks=pytest.mark.exhaustive)]
)
def limited(request: pytest.FixtureRequest, arm_with: Callable[[str], Any]) -> Iterator[Any]:
    """An FR3 whose joints may be a quarter as fast as the profile says."""
    with contextlib.contextmanager(arm_with)(
        f'{LIMITS}[plugins.fr3]\nengine = "{request.param}"\n'
    ) as arm:
        yield arm


@pytest.mark.parametrize(
    "beside",
    [
        pytest.param(False, marks=pytest.mark.exhaustive, id="alone"),
        pytest.param(True, id="beside a policy"),
    ],
)
@pytest.mark.parametrize(
    "count",
    [
        pytest.param(300, marks=pytest.mark.timeout(180)),
        pytest.param(10_000, marks=[pytest.mark.slow, pytest.mark.timeout(600)]),
    ],
)
def test_hostile_commands_move_no_joint_beyond_its_limits(
    limited: Any, wait: Wait, count: int, beside: bool
) -> None:
    arm = limited
    arm.start("robot", *(("control",) if beside else ()))
    wait(lambda: len(arm.states) > 10, 10.0, "the arm is measured")
    if beside:
        wait(lambda: arm.actions.get_subscription_count() >= 2, 10.0, "control listens")
    expected = {"claimed"} if beside else REASONS
    before = {word: arm.dropped("robot", word) for word in expected}
    start_s = time.monotonic()
    with arm.waving() if beside else contextlib.nullcontext():
        if beside:
            wait(arm.is_moving, 10.0, "the policy moves the arm")
        hostile_s = time.monotonic()
        sent = bombard(arm, count, seed=count + beside)
        told = {word: arm.dropped("robot", word) - before[word] for word in expected}
        if beside:
            wait(arm.is_moving, 10.0, "the policy still moves the arm")
            check_wave(arm, hostile_s)
    wait(arm.is_still, 30.0, "the arm stands once nobody asks for motion")
    check_motion(arm, start_s)
    assert len(sent) >= 19
    assert all(told.values()), f"{told} of {dict(sent)}"
    assert "/fr3/stranger" in arm.metric("robot", "refused")
    report = arm.supervisor.view("robot").report
    assert report.error_code == ""


def check_wave(arm: Any, since_s: float) -> None:
    """Check that the TCP moved along y, to and fro, and nowhere else."""
    places = arm.places(since_s)
    across_m, along_m = np.ptp(places[:, [0, 2]], axis=0), np.ptp(places[:, 1])
    assert (across_m < ASIDE_M).all(), across_m
    assert 0.03 < along_m < WAVE_M, along_m


def creep(publish: Callable[[Command], None], target: np.ndarray, steps: int) -> None:
    """Publish steps of less than half of the joints' velocities to a posture, as a JointState."""
    for share in np.linspace(0.0, 1.0, steps):
        place = HOME + (target - HOME) * share
        publish(JointState(name=list(ARM_JOINTS), position=place.tolist()))
        time.sleep(0.02)


@pytest.mark.parametrize(
    ("target", "rule", "steps"),
    [
        pytest.param(TABLE, "limit_collision", 200, id="table", marks=pytest.mark.exhaustive),
        pytest.param(LEFT, "limit_zone", 120, id="zone"),
    ],
)
def test_a_way_to_a_forbidden_place_ends_before_it(
    limited: Any, wait: Wait, target: np.ndarray, rule: str, steps: int
) -> None:
    arm = limited
    for kind in ("control", "robot"):
        if arm.supervisor.view(kind).phase == "running":
            arm.supervisor.stop(kind)
    arm.start("robot")  # at home
    commands, publish = HostileCommands(0, lambda: arm.states[-1][1]), publishers_on(arm.node)
    wait(lambda: len(arm.states) > 10 and arm.is_still(), 10.0, "the arm is measured")
    start_s = time.monotonic()
    near = HOME + (target - HOME) * 0.1
    whole = [HOME + (target - HOME) * share for share in np.linspace(0.02, 1.0, 50)]
    for number, message in enumerate(
        (
            commands.timed(target, 6.0),
            commands.points([near, target], 4.0),
            commands.points(whole, 0.1),
        )
    ):
        before = arm.dropped("robot", rule)
        publish(message)
        wait(lambda before=before: arm.dropped("robot", rule) > before, 5.0, f"refused: {number}")
    assert arm.is_still(), "of a refused command not even the first point is carried out"
    creep(publish, target, steps)
    wait(arm.is_still, 10.0, "the arm stands")
    assert np.abs(arm.states[-1][1] - HOME).max() > 0.1, "it went as far as it may"
    check_motion(arm, start_s)
