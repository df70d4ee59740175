"""The age of a page's samples by simulated clocks: drift is tolerated, a delay is not."""

from __future__ import annotations

import math

import pytest

from rn_standard.teleoperation.session import SILENT_S
from rn_view.teleoperation.sample_socket import OFFSET_S, PageTeleoperator
from roboneuron import InvalidInputError

PERIOD_S = 0.02
BEGIN_S = 5000.0
DELAY_S = 0.004


class Page:
    """A page whose clock begins at another time and drifts."""

    def __init__(self, drift: float = 0.0, ahead_s: float = 1e6) -> None:
        self.now_s = BEGIN_S
        self.number = 0
        self.teleoperator = PageTeleoperator()
        self.teleoperator.connected()
        self.lead()
        self._drift, self._ahead_s = drift, ahead_s

    def lead(self) -> None:
        self.teleoperator.open(lambda message_type, topic, callback: lambda: None)

    def send(self, delay_s: float = DELAY_S) -> float:
        """One sample a period later; returns its age on arrival."""
        self.now_s += PERIOD_S
        self.number += 1
        passed_s = self.now_s - BEGIN_S
        told = {
            "n": self.number,
            "t": self._ahead_s + passed_s * (1.0 + self._drift),
            "held": True,
            "twist": [0.0] * 6,
        }
        arrived_s = self.now_s + delay_s
        self.teleoperator.put(told, arrived_s)
        sample = self.teleoperator.read(0.0)
        assert sample is not None
        return arrived_s - sample.at_s


@pytest.mark.parametrize("drift", [-50e-6, 50e-6])
@pytest.mark.parametrize("ahead_s", [-1e6, 0.0, 1e6])
def test_clocks_that_drift_apart_make_no_sample_old(drift: float, ahead_s: float) -> None:
    page = Page(drift, ahead_s)
    ages = [page.send() for _ in range(round(2400.0 / PERIOD_S))]
    # the drift within the window, and rounding of large times
    assert max(ages) <= 50e-6 * (OFFSET_S + PERIOD_S) + 1e-6
    assert min(ages) >= -1e-6


@pytest.mark.parametrize("passed_s", [10.0, 300.0])
def test_a_delayed_sample_is_old(passed_s: float) -> None:
    page = Page(50e-6)
    for _ in range(round(passed_s / PERIOD_S)):
        page.send()
    assert page.send(0.3) > SILENT_S
    assert page.send() < SILENT_S


def test_a_page_that_becomes_slow_is_not_taken_for_drift_within_a_lead() -> None:
    page = Page()
    for _ in range(100):
        page.send()
    ages = [page.send(0.3) for _ in range(round(OFFSET_S / 2 / PERIOD_S))]
    assert min(ages) > SILENT_S


def test_a_new_lead_knows_nothing_of_the_clock_of_the_last_one() -> None:
    page = Page()
    page.send()
    page._ahead_s -= 3600.0  # that computer was asleep
    page.lead()
    assert page.send() == pytest.approx(0.0, abs=1e-6)


def test_a_time_that_is_no_number_does_not_spoil_the_next() -> None:
    page = Page()
    page.send()
    page.teleoperator.put({"n": 2, "t": None, "held": True, "twist": [0.0] * 6}, page.now_s)
    sample = page.teleoperator.read(0.0)
    assert sample is not None
    assert math.isnan(sample.at_s)  # the lead refuses it
    assert page.send() < SILENT_S


def test_an_invalid_sample_is_refused() -> None:
    page = Page()
    page.teleoperator.put({"n": 1}, page.now_s)
    with pytest.raises(InvalidInputError, match="invalid sample"):
        page.teleoperator.read(0.0)
