"""A dry run is answered by the motion that its request predicts."""

from __future__ import annotations

from dataclasses import replace

import pytest

from roboneuron.errors import ConfigurationError, RefusedError
from roboneuron.gate.motion.path_limits import LimitError


@pytest.mark.parametrize(
    ("cause", "rule", "text"),
    [
        (RefusedError("It would stop short."), "path", "It would stop short."),
        (LimitError("zone", "It would enter 'pane'."), "zone", "'pane'"),
        (
            ConfigurationError("There is no controller."),
            "path",
            "cannot be checked: There is no controller.",
        ),
    ],
)
def test_a_simulated_request_is_refused_by_its_prediction_and_audited_as_such(
    make_gate, ask, endpoints, audit, cause: Exception, rule: str, text: str
) -> None:
    def predict() -> None:
        raise cause

    gate = make_gate()
    request = replace(ask(endpoints["velocity"], {"linear": {"x": 0.1}}), predict=predict)
    verdict = gate.check(replace(request, simulated=True))
    assert (verdict.allowed, verdict.rule) == (False, rule)
    assert text in verdict.reason
    assert '"verdict":"would_refuse"' in audit.path.read_text()
    assert gate.check(request).may_send  # the real motion is judged while it is carried out
    assert not make_gate(simulated=True).check(request).allowed
