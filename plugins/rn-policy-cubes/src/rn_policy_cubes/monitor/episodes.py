"""Episodes in the simulated cell with injected failures, for training and judging a monitor of
success. An episode depends only on its kind and its number.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rn_policy_cubes.demonstrations import COLOURS, SIDE_PX, ShardRecorder, situations
from rn_policy_cubes.monitor.views import centre_px
from rn_policy_cubes.replacing import replacing
from rn_policy_cubes.teacher import LIFT_M, STEP_M, act
from rn_robot_fr3.cameras import cameras
from rn_robot_fr3.simulation import ArmSimulation
from rn_simulation.ground_truth import LIFTED_M

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

SUCCESS = "success"
FAILURES = ("dropped", "wrong_cube", "no_grasp", "pushed", "frozen", "occluded")
KINDS = (SUCCESS, *FAILURES)
"""What happens in an episode: the named cube is lifted and held, or an injected failure."""
HELD_S = 1.0
"""Time for which the named cube has to be held 10 cm up, as in the suite "cubes" [s]."""
FIRST_SCENE = 30_000_000
"""Scene of the first episode; those of demonstrations and of the policy's evaluation are lower."""
LOOK_EVERY = 3
"""Actions between two pictures: one each 0.3 s."""
VIEW = np.dtype(
    [
        ("time_s", "f8"),
        ("stamp_s", "f8"),
        ("tcp_m", "f4", (3,)),
        ("opening", "f4"),
        ("lifted_m", "f4", (len(COLOURS),)),
        ("distance_m", "f4", (len(COLOURS),)),
        ("held_s", "f4", (len(COLOURS),)),
        ("is_hidden", "?"),
    ]
)
"""State belonging to one picture; `stamp_s` is the picture's stamp, `time_s` the time at which it
is looked at, `is_hidden` tells that an obstacle covers the gripper.
"""

_PER_KIND = 100_000
_LOW_M = 0.12
_MOST_STEPS = 130
_AFTER_STEPS = 32
_DROPS = ("open", "fall", "slip")
_FAILING_HANDS = ("dropped", "wrong_cube", "no_grasp", "pushed")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class InjectedEpisode:
    """A recorded episode.

    Attributes:
        kind: one of `KINDS`.
        target: index of the named colour.
        seed: scene.
        views: of the dtype `VIEW`, (n,), in the order of time.
        pictures: uint8 (n, 224, 224, 3) RGB, as the camera delivers them.
    """

    kind: str
    target: int
    seed: int
    views: NDArray[np.void]
    pictures: U8

    @property
    def succeeded_s(self) -> float | None:
        """Time from which the simulator calls it a success; None if it never does."""
        true = self.views["held_s"][:, self.target] >= HELD_S
        return float(self.views["time_s"][np.argmax(true)]) if true.any() else None

    @property
    def failed_s(self) -> float:
        """Time from which success is out of reach for a careful eye: a dropped cube lies, or the
        hand is up without the named cube; the last view's if neither occurs.
        """
        views = self.views
        was_low = np.minimum.accumulate(views["tcp_m"][:, 2]) < _LOW_M
        up = was_low & (views["tcp_m"][:, 2] >= LIFT_M - 0.03)
        up |= views["lifted_m"].max(axis=1) >= LIFTED_M
        closed = views["opening"] < 0.9
        if self.kind == "dropped":
            was_up = np.maximum.accumulate(views["lifted_m"][:, self.target]) > 0.015
            found = was_up & (views["lifted_m"][:, self.target] < 0.01)
        else:
            found = up & closed & (views["lifted_m"][:, self.target] < 0.05)
        return float(views["time_s"][np.argmax(found) if found.any() else -1])


def seed_of(kind: str, index: int) -> int:
    """Scene of an episode; no two episodes share one."""
    return FIRST_SCENE + _PER_KIND * KINDS.index(kind) + index


def path_of(directory: Path, kind: str, index: int) -> Path:
    """File of an episode."""
    return directory / f"{kind}-{index:05d}.npz"


def write_episode(directory: Path, kind: str, index: int) -> bool:
    """Record an episode into its file; False if it was there already."""
    path = path_of(directory, kind, index)
    if path.exists():
        return False
    path.parent.mkdir(parents=True, exist_ok=True)
    made = record_episode(kind, seed_of(kind, index))
    with replacing(path) as unfinished, unfinished.open("wb") as file:
        np.savez_compressed(
            file,
            kind=made.kind,
            target=made.target,
            seed=made.seed,
            views=made.views,
            pictures=made.pictures,
        )
    return True


def read_episode(path: Path) -> InjectedEpisode:
    """Read an episode. Raises OSError or ValueError for a missing or damaged file."""
    with np.load(path, allow_pickle=False) as data:
        return InjectedEpisode(
            kind=str(data["kind"]),
            target=int(data["target"]),
            seed=int(data["seed"]),
            views=data["views"],
            pictures=data["pictures"],
        )


def record_episode(kind: str, seed: int) -> InjectedEpisode:
    """Run an episode in the simulated cell, with PyBullet."""
    return _EpisodeRecorder(kind, seed).run()


class _EpisodeRecorder(ShardRecorder):
    """One episode; the steps of its hand are a generator that yields actions (7,)."""

    def __init__(self, kind: str, seed: int) -> None:
        super().__init__(seed, 1)
        self._kind, self._scene = kind, seed
        random = self.random
        self._target = int(random.integers(len(COLOURS)))
        self._hand = kind
        if kind == "occluded":
            self._hand = str(random.choice(_FAILING_HANDS))
        if kind == "frozen":
            self._hand = str(random.choice(("dropped", "success", "no_grasp")))
        self._noise_m = float(random.choice([0.0, 0.002, 0.005]))
        self._looks: list[NDArray[np.void]] = []
        self._images: list[U8] = []
        self._frozen: tuple[U8, float] | None = None
        self._stops_stamps = bool(random.random() < 0.5)
        self._obstacle: _Obstacle | None = None
        self._event_step = 0

    def run(self) -> InjectedEpisode:  # type: ignore[override]
        """Run it; the camera looks every `LOOK_EVERY` actions."""
        with ArmSimulation(self._scene, engine="pybullet") as simulation:
            disturb_at = self._disturbance_step()
            for step, action in enumerate(self._steps(simulation)):
                if step % LOOK_EVERY == 0:
                    self._look_at(simulation, step >= disturb_at)
                if step >= _MOST_STEPS:
                    break
                self.execute(simulation, action)
        return InjectedEpisode(
            kind=self._kind,
            target=self._target,
            seed=self._scene,
            views=np.array(self._looks, dtype=VIEW),
            pictures=np.stack(self._images),
        )

    def _disturbance_step(self) -> float:
        """Step from which the camera is frozen or covered; a camera that freezes while the cube is
        in the hand is found by the state instead.
        """
        if self._kind == "frozen" and self._hand != "dropped":
            return float(self.random.integers(3, 40))
        if self._kind == "occluded":
            return float(self.random.integers(0, 45))
        return np.inf

    def _look_at(self, simulation: ArmSimulation, is_disturbed: bool) -> None:
        picture: U8 = simulation.render("front", SIDE_PX, SIDE_PX)
        cubes, tcp = simulation.cubes(), simulation.tcp_pose().position_m
        view = np.zeros((), dtype=VIEW)
        now_s = simulation.time_s
        view["time_s"] = view["stamp_s"] = now_s
        view["tcp_m"], view["opening"] = tcp, simulation.gripper_open()
        for index, colour in enumerate(COLOURS):
            cube = cubes[colour]
            view["lifted_m"][index], view["held_s"][index] = cube.lifted_m, cube.held_s
            view["distance_m"][index] = np.linalg.norm(cube.position_m - tcp)
        if self._kind == "frozen":
            lifted = float(view["lifted_m"][self._target])
            is_due = is_disturbed or (self._hand == "dropped" and lifted > 0.03)
            if self._frozen is None and is_due:
                self._frozen = picture, now_s
            if self._frozen is not None:
                picture = self._frozen[0]
                view["stamp_s"] = self._frozen[1] if self._stops_stamps else now_s
        if self._kind == "occluded" and is_disturbed:
            self._obstacle = self._obstacle or _Obstacle(self.random)
            picture = self._obstacle.put_into(picture, tcp)
            view["is_hidden"] = True
        self._looks.append(view)
        self._images.append(picture)

    def _steps(self, simulation: ArmSimulation) -> Iterator[F64]:
        """The hand's actions."""
        hand: dict[str, Callable[[ArmSimulation], Iterator[F64]]] = {
            "success": self._pick_target,
            "wrong_cube": self._pick_other,
            "dropped": self._drop,
            "no_grasp": self._grasp_nothing,
            "pushed": self._push,
        }
        if self.random.random() < 0.4:
            yield from self._wander_off(simulation)
        yield from hand[self._hand](simulation)

    def _wander_off(self, simulation: ArmSimulation) -> Iterator[F64]:
        goal = np.array([self.random.uniform(0.34, 0.62), self.random.uniform(-0.25, 0.25), 0.22])
        yield from self._go(simulation, goal, opening=1.0, most=8)

    def _pick_target(self, simulation: ArmSimulation) -> Iterator[F64]:
        yield from self._pick(simulation, self._target, until_held_s=HELD_S + 2.5)

    def _pick_other(self, simulation: ArmSimulation) -> Iterator[F64]:
        others = [index for index in range(len(COLOURS)) if index != self._target]
        yield from self._pick(
            simulation, int(self.random.choice(others)), until_held_s=HELD_S + 2.5
        )

    def _pick(self, simulation: ArmSimulation, cube: int, until_held_s: float) -> Iterator[F64]:
        """The teacher picks a cube until it is held for a time, or forever."""
        while simulation.cubes()[COLOURS[cube]].held_s < until_held_s:
            yield self._teach(simulation, cube)

    def _teach(self, simulation: ArmSimulation, cube: int) -> F64:
        now = situations(self.look(simulation, COLOURS[cube])[None], cube)
        action: F64 = act(now)[0]
        near = 0.3 if now.distance_m[0] < 0.03 else 1.0
        action[:3] += self.random.normal(0, self._noise_m * near, 3)
        return action

    def _drop(self, simulation: ArmSimulation) -> Iterator[F64]:
        """Lift the cube, and lose it before it counts: the hand opens, or it falls out."""
        random, name = self.random, COLOURS[self._target]
        height_m, way = random.uniform(0.03, 0.16), str(random.choice(_DROPS))
        later = int(random.integers(0, 6))
        if way == "slip":
            simulation.let_slip(float(random.uniform(0.0, 0.7)))
        while True:
            cube = simulation.cubes()[name]
            if way == "slip":
                if cube.lifted_m < 0.02 and self._was_up:
                    break
            elif cube.lifted_m >= height_m:
                if later == 0 or cube.held_s > HELD_S - 0.35:
                    break
                later -= 1
            yield self._teach(simulation, self._target)
        if way == "fall":
            self._let_fall(simulation, name)
        opening = 1.0 if way == "open" else 0.0
        goal = simulation.tcp_pose().position_m.copy()
        goal[2] = LIFT_M
        yield from self._go(simulation, goal, opening=opening, most=_AFTER_STEPS, stays=True)

    @property
    def _was_up(self) -> bool:
        return any(view["lifted_m"][self._target] > 0.05 for view in self._looks)

    def _let_fall(self, simulation: ArmSimulation, name: str) -> None:
        """Put the cube onto the table below the hand, at rest."""
        cube = simulation.cubes()[name]
        place = cube.position_m[:2] + self.random.normal(0, 0.015, 2)
        half_yaw = self.random.uniform(-np.pi / 8, np.pi / 8)
        turn = (0.0, 0.0, float(np.sin(half_yaw)), float(np.cos(half_yaw)))
        pose = (float(place[0]), float(place[1]), cube.edge_m / 2), turn
        simulation.world.set_cubes({name: pose})

    def _grasp_nothing(self, simulation: ArmSimulation) -> Iterator[F64]:
        """Close beside the cube, or above it, and rise with the hand empty."""
        random, name = self.random, COLOURS[self._target]
        cube = simulation.cubes()[name].position_m
        angle = random.uniform(-np.pi, np.pi)
        beside = random.uniform(0.045, 0.09) * np.array([np.cos(angle), np.sin(angle)])
        is_above = random.random() < 0.4
        goal = np.array([*(cube[:2] if is_above else cube[:2] + beside), 0.0])
        goal[2] = random.uniform(0.085, 0.11) if is_above else random.uniform(0.02, 0.05)
        over = np.array([goal[0], goal[1], 0.14])
        yield from self._go(simulation, over, opening=1.0, most=30)
        yield from self._go(simulation, goal, opening=1.0, most=12)
        yield from self._go(simulation, goal, opening=0.0, most=9, stays=True)
        up = np.array([goal[0], goal[1], LIFT_M])
        yield from self._go(simulation, up, opening=0.0, most=_AFTER_STEPS, stays=True)

    def _push(self, simulation: ArmSimulation) -> Iterator[F64]:
        """Push the cube with closed fingers, and rise."""
        random = self.random
        cube = simulation.cubes()[COLOURS[self._target]].position_m
        angle = random.uniform(-np.pi, np.pi)
        along = np.array([np.cos(angle), np.sin(angle), 0.0])
        low = np.array([cube[0], cube[1], 0.03])
        before, behind = low - 0.10 * along, low + random.uniform(0.02, 0.06) * along
        up = np.array([0.0, 0.0, 0.11])
        yield from self._go(simulation, before + up, opening=0.0, most=30)
        yield from self._go(simulation, before, opening=0.0, most=10)
        yield from self._go(simulation, behind, opening=0.0, most=16)
        top = np.array([behind[0], behind[1], LIFT_M])
        yield from self._go(simulation, top, opening=0.0, most=_AFTER_STEPS, stays=True)

    def _go(
        self,
        simulation: ArmSimulation,
        goal: F64,
        *,
        opening: float,
        most: int,
        stays: bool = False,
    ) -> Iterator[F64]:
        """Straight towards a place, for `most` actions at the longest, or exactly if it stays."""
        for _ in range(most):
            move = goal - simulation.tcp_pose().position_m
            distance = float(np.linalg.norm(move))
            if distance < 0.008 and not stays:
                return
            move = 0.6 * move * min(1.0, STEP_M / max(0.6 * distance, 1e-9))
            move += self.random.normal(0, self._noise_m * 0.5, 3)
            yield np.array([*move, 0.0, 0.0, 0.0, opening])


class _Obstacle:
    """Something between the camera and the gripper: a patch of one colour, or of noise."""

    def __init__(self, random: np.random.Generator) -> None:
        self._half = random.integers(20, 70, 2)
        self._shift = random.integers(-8, 9, 2)
        colour = random.integers(0, 256, 3)
        size = (2 * self._half[1], 2 * self._half[0], 3)
        grain = float(random.choice([0.0, 6.0, 40.0]))
        patch = colour + random.normal(0, grain, size)
        self._patch = np.clip(patch, 0, 255).astype(np.uint8)

    def put_into(self, picture: U8, tcp_m: F64) -> U8:
        """The picture (224, 224, 3) with the patch over the projected TCP."""
        made = picture.copy()
        centre = centre_px(cameras()[0].calibration(SIDE_PX, SIDE_PX), tcp_m) + self._shift
        low = np.round(centre).astype(int) - self._half
        height, width = made.shape[:2]
        first, last = np.clip(low, 0, (width, height)), np.clip(low + 2 * self._half, 0, width)
        part = self._patch[
            first[1] - low[1] : last[1] - low[1], first[0] - low[0] : last[0] - low[0]
        ]
        made[first[1] : last[1], first[0] : last[0]] = part
        return made
