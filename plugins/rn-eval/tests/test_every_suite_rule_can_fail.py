"""Each rule of suites is broken by some suite; the toy suite that they derive from keeps all
rules.
"""

from __future__ import annotations

import itertools
import os
import random
import sys
from dataclasses import replace
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rn_eval.contract_cases import SuiteCase
from rn_eval.hooks import SuiteSpec
from rn_eval.suite import Setup
from rn_eval.suite_rules import RULES
from rn_testing import effects
from rn_testing.fakes import gantry_profile
from rn_testing.rule import RuleVerdict
from rn_testing.verification import verify
from roboneuron import CameraProfile
from roboneuron.config import load_config

_found = spec_from_file_location("toy_of_the_suite_rules", Path(__file__).parent / "toy_parts.py")
assert _found is not None
assert _found.loader is not None
_parts: Any = module_from_spec(_found)
sys.modules[_found.name] = _parts  # pydantic resolves annotations there
_found.loader.exec_module(_parts)
Toy, ToyOptions, ToyScene = _parts.Toy, _parts.ToyOptions, _parts.ToyScene
LEFT: list[int] = []
SPEC = SuiteSpec(
    name="toy",
    summary="Reach a point.",
    target="toy_parts:Toy",
    config=f"{__name__}:ToyConfig",
    robot="fr3",
)
_counts = itertools.count()


class ToyConfig(ToyOptions):  # type: ignore[misc,valid-type]
    """Options of the toy suite."""


class Good(Toy):  # type: ignore[misc,valid-type]
    """The toy suite, with its own scene for mutants to change."""

    scene: type = ToyScene

    def open(self, episode, setup):
        super().open(episode, setup)
        return self.scene(episode)


def with_scene(**changes: Any) -> type:
    """A suite whose scenes differ from the good one's."""
    return type("Changed", (Good,), {"scene": type("ChangedScene", (ToyScene,), changes)})


def changed(**changes: Any) -> type:
    """A suite that differs from the good one."""
    return type("Changed", (Good,), changes)


def episodes(change):
    return changed(
        episodes=lambda self, count, first: change(list(Toy.episodes(self, count, first)))
    )


def every(**fields: Any) -> type:
    """A suite whose episodes all have these fields."""
    return episodes(lambda found: [replace(episode, **fields) for episode in found])


def judged(**fields: Any) -> type:
    return with_scene(judge=lambda self: replace(ToyScene.judge(self), **fields))


def seen(change):
    return with_scene(observe=lambda self, stamp_ns: change(self, ToyScene.observe(self, stamp_ns)))


def drifting(self):
    self.here = self.here + 1e-3
    return ToyScene.judge(self)


def done_when_idle(self):
    judgement = ToyScene.judge(self)
    return replace(judgement, success=getattr(self, "ticks", 0) > 0)


def count_ticks(self, ticks):
    self.ticks = ticks
    ToyScene.advance(self, ticks)


def once_per_call(self, ticks):
    self.here = self.here + self.speed * self.tick_s


def noisy(self, ticks):
    ToyScene.advance(self, ticks)
    self.here = self.here + 1e-6 * random.SystemRandom().random()


def remembered(self, episode, setup):
    self.played = getattr(self, "played", 0) + 1
    scene = ToyScene(episode)
    scene.here = scene.here + 0.01 * self.played
    return scene


def shared_picture(self, observation):
    buffer = self.__dict__.setdefault("buffer", np.zeros((32, 32, 3), np.uint8))
    frame = observation.frames["primary"]
    buffer[:] = frame.image
    return replace(observation, frames={"primary": replace(frame, image=buffer)})


def opens_a_file(self, episode, setup):
    LEFT.append(os.open("/dev/null", os.O_RDONLY))
    return Toy.open(self, episode, setup)


def needs_open(self):
    if not getattr(self, "was_open", False):
        raise RuntimeError("nothing to close")


def of_a_file(self, config):
    open("/proc/self/status", "rb").close()
    Toy.__init__(self, config)


def printing(self, vector, now_s):
    print(vector)
    return ToyScene.act(self, vector, now_s)


def seeding(self, episode, setup):
    np.random.seed(episode.seed)
    return Toy.open(self, episode, setup)


MUTANTS: dict[str, tuple[str, type]] = {
    "no close": ("protocol", changed(close=None)),
    "close needs open": ("protocol", changed(close=needs_open)),
    "constructor reads a file": ("constructor-pure", changed(__init__=of_a_file)),
    "options ignored": (
        "options-read",
        changed(__init__=lambda self, config: Toy.__init__(self, None)),
    ),
    "prints every action": ("process-left-alone", with_scene(act=printing)),
    "seeds the global generator": ("process-left-alone", changed(open=seeding)),
    "leaves a file open": ("close-releases", changed(open=opens_a_file)),
    "one episode too few": ("episodes-usable", episodes(lambda found: found[1:])),
    "one episode twice": ("episodes-usable", episodes(lambda found: [found[0], *found[:-1]])),
    "every seed the same": ("episodes-usable", every(task="reach", seed=4)),
    "no instruction": ("episodes-usable", every(instruction="")),
    "instruction of two lines": ("episodes-usable", every(instruction="reach\nit")),
    "no task": ("episodes-usable", every(task="")),
    "negative time limit": ("episodes-usable", every(time_limit_s=-1.0)),
    "endless time limit": ("episodes-usable", every(time_limit_s=float("inf"))),
    "episodes at random": (
        "episodes-stable",
        changed(
            episodes=lambda self, count, first: Toy.episodes(
                self, count, first + 100 * next(_counts)
            )
        ),
    ),
    "episodes by count": (
        "episodes-stable",
        changed(episodes=lambda self, count, first: Toy.episodes(self, count, first + 100 * count)),
    ),
    "first seed ignored": (
        "episodes-stable",
        changed(episodes=lambda self, count, first: Toy.episodes(self, count, 0)),
    ),
    "tick of zero": ("scene-clock", with_scene(tick_s=0.0)),
    "tick in milliseconds": ("scene-clock", with_scene(tick_s=10.0)),
    "half a camera tick": ("scene-clock", with_scene(camera_ticks=0.5)),
    "no judgement before the end": ("scene-clock", with_scene(judge_ticks=10**6)),
    "another instruction": ("scene-observed", seen(lambda s, o: replace(o, instruction="wait"))),
    "stamp ignored": (
        "scene-observed",
        seen(
            lambda s, o: replace(o, frames={n: replace(f, stamp_ns=1) for n, f in o.frames.items()})
        ),
    ),
    "camera absent": ("scene-observed", seen(lambda s, o: replace(o, frames={}))),
    "state absent": ("scene-observed", seen(lambda s, o: replace(o, ee_pose=None))),
    "one buffer for all pictures": ("scene-observed", seen(shared_picture)),
    "noise in the physics": ("scene-repeats", with_scene(advance=noisy)),
    "episodes depend on those before": ("scene-repeats", changed(open=remembered)),
    "seed ignored": (
        "seeds-differ",
        changed(open=lambda self, episode, setup: ToyScene(replace(episode, seed=1))),
    ),
    "actions ignored": ("actions-act", with_scene(act=lambda self, vector, now_s: "")),
    "act says nothing": (
        "actions-act",
        with_scene(act=lambda self, v, now_s: (ToyScene.act(self, v, now_s), None)[1]),
    ),
    "ticks ignored": ("ticks-add-up", with_scene(advance=once_per_call)),
    "success at the start": ("nothing-done-is-no-success", judged(success=True)),
    "over at the start": ("nothing-done-is-no-success", judged(is_over=True)),
    "success by waiting": (
        "nothing-done-is-no-success",
        with_scene(judge=done_when_idle, advance=count_ticks),
    ),
    "judge moves the arm": ("judge-harmless", with_scene(judge=drifting)),
    "judge draws": (
        "judge-harmless",
        with_scene(judge=lambda s: replace(ToyScene.judge(s), reason=f"{next(_counts)}")),
    ),
    "failure without reason": ("judge-harmless", judged(reason="")),
    "reason of a page": ("judge-harmless", judged(reason="no " * 500)),
    "fact of nan": ("judge-harmless", judged(facts={"distance_m": float("nan")})),
    "fact of a list": ("judge-harmless", judged(facts={"path": [1, 2]})),
    "judge returns a flag": ("judge-harmless", with_scene(judge=lambda self: False)),
}


def make_case(target: type, monkeypatch: pytest.MonkeyPatch) -> SuiteCase:
    """A case of the toy suite with that class as target and default options."""
    camera = CameraProfile(name="front", role="primary", frame_id="front", width=32, height=32)
    config = load_config(None)
    setup = Setup(
        profile=gantry_profile(),
        cameras={"primary": camera},
        controller=None,
        config=config,
        needs_state=True,
    )
    monkeypatch.setattr(SuiteCase, "_target", lambda self, descriptor: target)
    return SuiteCase(spec=SPEC, options={"crashes": False}, setup=lambda: setup)


@pytest.fixture(autouse=True)
def _what_is_left_open():
    yield
    while LEFT:
        os.close(LEFT.pop())


def own(name: str) -> Any:
    return next(rule for rule in RULES if rule.id == f"suite/{name}")


@pytest.mark.parametrize(
    "rule", [r for r in RULES if r.id.startswith("suite/")], ids=lambda rule: rule.id
)
def test_the_toy_keeps_every_rule(rule, monkeypatch):
    outcome = verify(rule, make_case(Good, monkeypatch))
    assert outcome.verdict is RuleVerdict.PASSED, outcome


@pytest.mark.parametrize("name", MUTANTS)
def test_a_broken_suite_fails_its_rule(name, monkeypatch):
    rule_name, target = MUTANTS[name]
    monkeypatch.setattr(effects, "RELEASE_S", 0.3)  # what a mutant leaves open stays for seconds
    outcome = verify(own(rule_name), make_case(target, monkeypatch))
    assert outcome.verdict is RuleVerdict.FAILED, outcome
    assert outcome.detail


def test_every_rule_has_a_suite_that_breaks_it():
    assert {f"suite/{rule}" for rule, _ in MUTANTS.values()} == {
        r.id for r in RULES if r.id.startswith("suite/")
    }
