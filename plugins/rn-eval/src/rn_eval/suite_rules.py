"""The contract rules of suites; loaded only by the contract kit and by tests."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, cast

import numpy as np

from rn_eval.contract_cases import TICKS, SuiteCase
from rn_eval.suite import Episode, Judgement, Scene, Suite
from rn_testing.attempts import attempt
from rn_testing.effects import check_releases
from rn_testing.kinds import Kind
from rn_testing.lifecycle import ALONE, PURE, check_pure_constructor
from rn_testing.options import OPTIONS_READ, check_options_read
from rn_testing.process_state import find_changes
from rn_testing.rule import Rule, require
from rn_testing.rules.descriptor import RULES as OF_EVERY_DESCRIPTOR
from rn_testing.snapshots import snapshot
from roboneuron import Observation

STAMP_NS = 7_000_000_000
"""Stamp of the images in the rules."""
LONGEST = 300
"""Maximum length of an instruction or a reason in characters."""


@contextmanager
def _suite(case: SuiteCase) -> Iterator[Suite]:
    suite = attempt(case, case.build)
    try:
        yield suite
    finally:
        suite.close()


@contextmanager
def _scene(case: SuiteCase, suite: Suite, episode: Episode) -> Iterator[Scene]:
    scene = attempt(case, lambda: suite.open(episode, case.make_setup()))
    try:
        yield scene
    finally:
        scene.close()


@contextmanager
def _first_scene(case: SuiteCase) -> Iterator[tuple[Scene, Episode]]:
    with _suite(case) as suite:
        episode = suite.episodes(1, 0)[0]
        with _scene(case, suite, episode) as scene:
            yield scene, episode


def _check_methods(case: SuiteCase) -> None:
    made = attempt(case, case.build)
    missing = [
        name for name in ("episodes", "open", "close") if not callable(getattr(made, name, None))
    ]
    require(not missing, f"{type(made).__name__} lacks {', '.join(missing)}")
    made.close()
    made.close()


def _check_options(case: SuiteCase) -> None:
    def use(make: Callable[[], Suite]) -> None:
        suite = make()
        try:
            with _scene(case, suite, suite.episodes(1, 0)[0]) as scene:
                scene.observe(STAMP_NS)
                scene.judge()
        finally:
            suite.close()

    check_options_read(case, use)


def _keys(episodes: Sequence[Episode]) -> list[tuple[str, int]]:
    return [(episode.task, episode.seed) for episode in episodes]


def _check_episodes(case: SuiteCase) -> None:
    with _suite(case) as suite:
        episodes = suite.episodes(6, 3)
    require(len(episodes) == 6, f"6 episodes were asked for, {len(episodes)} came")
    require(len(set(_keys(episodes))) == 6, "two episodes have the same task and seed")
    for episode in episodes:
        who = f"the episode of seed {episode.seed}"
        require(
            bool(episode.task.strip()) and episode.task.isprintable(),
            f"{who} has the task {episode.task!r}",
        )
        text = episode.instruction
        good = bool(text.strip()) and text.isprintable() and len(text) <= LONGEST
        require(
            good,
            f"{who} has the instruction {text[:60]!r}, expected one line that a policy can be told",
        )
        limit_s = episode.time_limit_s
        require(math.isfinite(limit_s) and limit_s > 0, f"{who} has a time limit of {limit_s} s")


def _check_stable(case: SuiteCase) -> None:
    with _suite(case) as suite:
        few, many, again = suite.episodes(2, 3), suite.episodes(6, 3), suite.episodes(2, 3)
        others = suite.episodes(2, 9)
    require(list(few) == list(again), "the same call of `episodes` gives other episodes")
    lost = set(_keys(few)) - set(_keys(many))
    require(not lost, f"6 episodes lack {sorted(lost)}, which are among the first 2")
    require(not set(_keys(few)) & set(_keys(others)), "another first_seed gives the same episodes")


def _check_clock(case: SuiteCase) -> None:
    with _first_scene(case) as (scene, episode):
        tick_s, camera, judge = scene.tick_s, scene.camera_ticks, scene.judge_ticks
    require(math.isfinite(tick_s) and 0 < tick_s <= 1.0, f"tick_s is {tick_s}, expected seconds")
    whole = isinstance(camera, int) and isinstance(judge, int) and camera >= 1 and judge >= 1
    require(
        whole, f"camera_ticks is {camera}, judge_ticks {judge}; expected whole numbers from 1 on"
    )
    ticks = episode.time_limit_s / tick_s
    require(
        ticks >= max(camera, judge),
        f"an episode of {ticks:g} ticks ends before its first picture or judgement",
    )


def _check_observation(case: SuiteCase) -> None:
    setup = case.make_setup()
    with _first_scene(case) as (scene, episode):
        first = scene.observe(STAMP_NS)
        kept = snapshot(first)
        scene.act(case.move, 0.0)
        scene.advance(TICKS)
        later = scene.observe(STAMP_NS + 1)
    require(
        isinstance(first, Observation),
        f"observe returned {type(first).__name__}, expected an Observation",
    )
    require(first.instruction == episode.instruction, f"the instruction is {first.instruction!r}")
    missing = sorted(setup.cameras.keys() - first.frames.keys())
    require(not missing, f"observe lacks the frames {', '.join(missing)}")
    for role, frame in first.frames.items():
        require(
            frame.stamp_ns == STAMP_NS,
            f"the frame {role!r} is stamped {frame.stamp_ns}, asked for {STAMP_NS}",
        )
        require(bool(frame.frame_id), f"the frame {role!r} has no frame_id")
    if setup.needs_state:
        require(
            first.ee_pose is not None and first.gripper_open is not None,
            "observe lacks the state, which is needed",
        )
    require(snapshot(first) == kept, "an observation changes when the scene goes on")
    shared = any(
        np.shares_memory(first.frames[r].image, later.frames[r].image) for r in first.frames
    )
    require(not shared, "two observations share the memory of their pictures")


def _play(
    case: SuiteCase, suite: Suite, episode: Episode, *, is_idle: bool = False
) -> tuple[object, object, bytes]:
    """Return first observation, last observation, and final state."""
    with _scene(case, suite, episode) as scene:
        first = snapshot(scene.observe(STAMP_NS))
        if not is_idle:
            word = scene.act(case.move, 0.0)
            require(isinstance(word, str), f"act returned {word!r}, expected a word or none")
        scene.advance(TICKS)
        return first, snapshot(scene.observe(STAMP_NS)), bytes(scene.state())


def _check_repeats(case: SuiteCase) -> None:
    with _suite(case) as suite:
        one, other = suite.episodes(2, 0)
        played = _play(case, suite, one)
        _play(case, suite, other)
        again = _play(case, suite, one)
    with _suite(case) as fresh:
        elsewhere = _play(case, fresh, one)
    for what, run in (("after another episode", again), ("of a second suite", elsewhere)):
        require(run[0] == played[0], f"the same episode {what} begins otherwise")
        require(run[1:] == played[1:], f"the same episode and actions {what} end otherwise")


def _check_seeds(case: SuiteCase) -> None:
    with _suite(case) as suite:
        episodes = suite.episodes(3, 0)
        begun = [_play(case, suite, episode)[:2] for episode in episodes]
    require(any(run != begun[0] for run in begun[1:]), "episodes of other seeds show the same")


def _check_actions(case: SuiteCase) -> None:
    with _suite(case) as suite:
        episode = suite.episodes(1, 0)[0]
        acted, idle = _play(case, suite, episode), _play(case, suite, episode, is_idle=True)
    require(acted[1:] != idle[1:], f"{TICKS} ticks after an action everything is as without it")


def _check_ticks(case: SuiteCase) -> None:
    states = []
    with _suite(case) as suite:
        episode = suite.episodes(1, 0)[0]
        for steps in ((TICKS,), (TICKS // 2, TICKS - TICKS // 2)):
            with _scene(case, suite, episode) as scene:
                scene.act(case.move, 0.0)
                for ticks in steps:
                    scene.advance(ticks)
                states.append(bytes(scene.state()))
    require(states[0] == states[1], f"{TICKS} ticks at once and in two parts end otherwise")


def _check_start(case: SuiteCase) -> None:
    with _first_scene(case) as (scene, _):
        at_once = scene.judge()
        scene.advance(case.idle_ticks)
        later = scene.judge()
    require(
        not (at_once.success or at_once.is_over),
        f"an episode is decided before anything was done: {at_once}",
    )
    require(not later.success, f"doing nothing for {case.idle_ticks} ticks is a success")


def _check_judge(case: SuiteCase) -> None:
    with _first_scene(case) as (scene, _):
        before = bytes(scene.state())
        judged: list[Any] = [scene.judge() for _ in range(2)]
        scene.observe(STAMP_NS)
        scene.state()
        after = bytes(scene.state())
    first = judged[0]
    require(
        isinstance(first, Judgement), f"judge returned {type(first).__name__}, expected a Judgement"
    )
    require(first == judged[1], "judge says something else when it is asked again")
    require(before == after, "judge, observe or state changes the scene")
    reason = first.reason
    good = bool(reason.strip()) and "\n" not in reason and len(reason) <= LONGEST
    require(first.success or good, f"a failure's reason is {reason[:60]!r}, expected one sentence")
    odd = [name for name, value in first.facts.items() if not _is_fact(value)]
    require(not odd, f"facts that are neither text nor finite numbers: {', '.join(odd)}")


def _is_fact(value: object) -> bool:
    return isinstance(value, str) or (isinstance(value, (int, float)) and math.isfinite(value))


def _run_through(case: SuiteCase) -> Suite:
    suite = attempt(case, case.build)
    scene = attempt(case, lambda: suite.open(suite.episodes(1, 0)[0], case.make_setup()))
    scene.observe(STAMP_NS)
    scene.act(case.move, 0.0)
    scene.advance(TICKS)
    scene.watch(0.1)
    scene.judge()
    for closable in (scene, scene, suite, suite):
        closable.close()
    return suite


def _check_process(case: SuiteCase) -> None:
    changes = find_changes(lambda: _run_through(case))
    require(not changes, f"it {'; '.join(changes)}")


_OWN: tuple[Rule[SuiteCase], ...] = tuple(
    Rule(id=f"suite/{name}", text=text, source=f"rn_eval.suite.{source}", check=check)
    for name, source, text, check in (
        (
            "protocol",
            "Suite",
            "It has the methods of Suite; `close` may be called twice and at once.",
            _check_methods,
        ),
        ("constructor-pure", "Suite", PURE, check_pure_constructor),
        ("options-read", "Suite", OPTIONS_READ, _check_options),
        ("process-left-alone", "Suite", ALONE, _check_process),
        (
            "close-releases",
            "Suite.close",
            "Scenes and suite may be closed twice, and leave no thread, process or open file "
            "behind.",
            lambda case: check_releases(lambda: _run_through(case), "close()"),
        ),
        (
            "episodes-usable",
            "Episode",
            "As many episodes come as are asked for, all different, each with a task, an "
            "instruction and a time limit.",
            _check_episodes,
        ),
        (
            "episodes-stable",
            "Suite.episodes",
            "The same call gives the same episodes, more of them contain these, another first "
            "seed gives others.",
            _check_stable,
        ),
        (
            "scene-clock",
            "Scene",
            "Ticks are seconds; pictures and judgements come after whole ticks.",
            _check_clock,
        ),
        (
            "scene-observed",
            "Scene.observe",
            "An observation has the stamp asked for, the instruction, every camera and the state; "
            "nothing changes it.",
            _check_observation,
        ),
        (
            "scene-repeats",
            "Scene",
            "The same episode and actions give the same scene bit for bit, whatever was played "
            "before.",
            _check_repeats,
        ),
        ("seeds-differ", "Episode", "Episodes of other seeds differ.", _check_seeds),
        (
            "actions-act",
            "Scene.act",
            "An action has an effect, and `act` returns a word.",
            _check_actions,
        ),
        (
            "ticks-add-up",
            "Scene.advance",
            "Time passes alike in one step or in several.",
            _check_ticks,
        ),
        (
            "nothing-done-is-no-success",
            "Scene.judge",
            "Nothing is decided at the start; idleness fails.",
            _check_start,
        ),
        (
            "judge-harmless",
            "Judgement",
            "A judgement changes nothing, can be repeated, and a failure has a reason of one "
            "sentence.",
            _check_judge,
        ),
    )
)
RULES: tuple[Rule[SuiteCase], ...] = (
    *cast("tuple[Rule[SuiteCase], ...]", OF_EVERY_DESCRIPTOR),
    *_OWN,
)
"""Rules of a suite: those of every descriptor (none is marked, because no agent sets its options),
and its own.
"""
KIND = Kind(case=SuiteCase, rules=RULES)
"""Description of suites for the contract kit."""
