"""Rules of backends on control spaces: chunks are in the space that `space` declares."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from typing import cast

from rn_testing.cases import BackendCase
from rn_testing.effects import HEAVY_MODULES
from rn_testing.rule import NotApplicable, Rule, require
from rn_testing.rules.backend import backend_rule, loaded, predict
from roboneuron import EE_DELTA, ControlSpace
from roboneuron.feature import loading

PERIOD_SHARE = 0.02
"""Tolerance of a period relative to the declared rate."""
_ASK_S = 60.0
_ASK = f"""
import pickle, sys
module, attribute, options, profile = pickle.load(sys.stdin.buffer)
function = getattr(__import__(module, fromlist=["x"]), attribute)
function(options, profile)
print(*[name for name in {HEAVY_MODULES!r} if name in sys.modules])
"""


def declared_space(case: BackendCase) -> ControlSpace:
    """The declared space of the case's chunks."""
    spec = case.spec
    if spec.space is None:
        return EE_DELTA
    function = cast(
        "Callable[..., object]", loading.load_attribute(spec.space, f"`space` of {spec.name!r}")
    )
    space = function(dict(case.options), case.robot_profile())
    require(
        isinstance(space, ControlSpace),
        f"`space` returned {type(space).__name__}, expected ControlSpace",
    )
    return cast("ControlSpace", space)


def _check_answers(case: BackendCase) -> None:
    if case.spec.space is None:
        raise NotApplicable("it declares no space")
    space = declared_space(case)
    require(
        space == declared_space(case), "`space` returned two different spaces for the same options"
    )
    require(
        space.kind != "joint_velocity" or space.rate_hz > 0.0,
        "`space` says velocities but no rate_hz, so it is unknown how long one is held",
    )
    require(
        space.kind != "joint_delta" or case.spec.needs_state,
        "`space` says joint_delta but the descriptor lacks needs_state, so it is unknown what "
        "the deltas are relative to",
    )


def _check_light(case: BackendCase) -> None:
    if case.spec.space is None:
        raise NotApplicable("it declares no space")
    module, _, attribute = case.spec.space.partition(":")
    asked = pickle.dumps((module, attribute, dict(case.options), case.robot_profile()))
    done = subprocess.run(
        [sys.executable, "-P", "-c", _ASK],
        input=asked,
        capture_output=True,
        timeout=_ASK_S,
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    error = done.stderr.decode(errors="replace").strip()
    require(done.returncode == 0, f"`space` fails in a new process: {error[-300:]}")
    heavy = done.stdout.decode().strip()
    require(not heavy, f"`space` imports {heavy}; it is asked before anything is loaded")


def _check_kept(case: BackendCase) -> None:
    space = declared_space(case)
    with loaded(case) as backend:
        chunk = predict(case, backend)
    is_alike = chunk.space.label == space.label
    require(
        chunk.space == space,
        f"a chunk is in {chunk.space.label!r}{' of other units or frames' if is_alike else ''}, "
        f"declared is {space.label!r}",
    )
    rate_hz = 1.0 / chunk.step_s
    require(
        not space.rate_hz or abs(rate_hz / space.rate_hz - 1.0) <= PERIOD_SHARE,
        f"a chunk has {rate_hz:.4g} rows a second, declared {space.rate_hz:g}",
    )


_SOURCE = "roboneuron.plugins.specs.BackendSpec"
RULES: tuple[Rule[BackendCase], ...] = (
    backend_rule(
        "space-answers",
        "`space` returns a ControlSpace that can be executed for the case's options.",
        _SOURCE,
        _check_answers,
    ),
    backend_rule(
        "space-light",
        "`space` needs no heavy import, because it is called before anything is loaded.",
        _SOURCE,
        _check_light,
    ),
    backend_rule(
        "space-kept",
        "Chunks are in the declared space, the default without `space`, and have its rate.",
        "roboneuron.contract.action.ActionChunk",
        _check_kept,
    ),
)
"""Rules of backends on control spaces."""
