"""Step filters of a module: their order, and what one of them decides for all."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from roboneuron.errors import PluginError
from roboneuron.modules.control.module import ControlModule
from roboneuron.modules.inference.module import InferenceModule
from roboneuron.modules.step_filters import ActionStep, StepFilter, StepFilters

STEP = ActionStep(source_ns=7, read=lambda: None)  # type: ignore[arg-type,return-value]


class Named(StepFilter):
    """Notes in `passed` what passes it."""

    def __init__(self, name: str, phase: StepFilter.StepPhase, passed: list[str]) -> None:
        self.name, self._passed = name, passed
        self.phase = phase  # type: ignore[misc]

    def act(self, step: ActionStep, proceed: Callable[[ActionStep], None]) -> None:
        self._passed.append(self.name)
        proceed(step)


def test_an_action_passes_the_phases_in_order_and_within_one_as_added() -> None:
    passed: list[str] = []
    phases = StepFilter.StepPhase
    filters = StepFilters([Named("report", phases.REPORT, passed)])
    filters.add(Named("first lead", phases.PERSON, passed))
    filters.add(Named("clock", phases.CLOCK, passed))
    filters.add(Named("second lead", phases.PERSON, passed))
    filters.act(STEP, lambda step: passed.append(str(step.source_ns)))
    assert passed == ["clock", "first lead", "second lead", "report", "7"]


@pytest.mark.parametrize("asked", ["admits", "sends"])
def test_one_filter_is_enough_to_keep_an_input_or_an_output(asked: str) -> None:
    no: Any = StepFilter()
    setattr(no, asked, lambda stamp_ns: stamp_ns > 5)
    filters = StepFilters([StepFilter(), no, StepFilter()])
    ask = getattr(filters, asked)
    assert (ask(5), ask(6)) == (False, True)
    assert (filters.is_ours(5), filters.is_ours(6)) == (False, True)


def test_a_filter_that_does_nothing_passes_everything_on() -> None:
    filters, passed = StepFilters([StepFilter()]), list[object]()
    answer: Any = object()
    filters.act(STEP, passed.append)
    filters.deliver(answer, passed.append)
    assert filters.predict(answer, lambda request: request) is answer  # type: ignore[arg-type,return-value]
    assert passed == [STEP, answer]
    (one,) = filters
    assert (one.may_play(1), one.ends_rows(1)) == (True, False)


@pytest.mark.parametrize(
    ("module", "name"),
    [
        *((ControlModule, "deliver"), (ControlModule, "on_limited")),
        *((InferenceModule, "deliver"), (InferenceModule, "accepts")),
        *((InferenceModule, "on_prediction"), (InferenceModule, "before_prediction")),
    ],
)
def test_what_features_set_once_names_what_replaces_it(module: type, name: str) -> None:
    old = module.__new__(module)
    with pytest.raises(PluginError, match="StepFilter"):
        setattr(old, name, [])
