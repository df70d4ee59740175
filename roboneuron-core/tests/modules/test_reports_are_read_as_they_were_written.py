"""One class writes a module's report and reads it back."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from roboneuron.errors import InternalError, UngroundedError
from roboneuron.modules.report import Report

TEXT = st.text(max_size=20)
NUMBER = st.none() | st.floats(min_value=-1e6, max_value=1e6).map(lambda x: float(f"{x:.6g}"))
REPORTS = st.builds(
    Report,
    state=TEXT,
    ready=st.booleans(),
    error_count=st.integers(0, 999),
    loop_age_s=NUMBER,
    rate_hz=NUMBER,
    note=TEXT,
    emergency_stop=st.none() | st.booleans(),
    dropped_by=st.dictionaries(TEXT, st.integers(0, 999), max_size=3),
    detail=st.dictionaries(TEXT, TEXT, max_size=3),
    metrics=st.dictionaries(st.from_regex("[A-Z]{1,9}", fullmatch=True), TEXT, max_size=3),
)


@given(REPORTS)
def test_what_is_written_is_read(report: Report) -> None:
    assert Report.from_values(report.to_values()) == report


@pytest.mark.parametrize("text", ["", "fast", "nan", "inf", "1e999"])
def test_a_malformed_number_counts_as_not_said(text: str) -> None:
    report = Report.from_values({"rate_hz": text, "published": text})
    assert (report.rate_hz, report.published) == (None, 0)


def test_nothing_said_is_an_empty_report() -> None:
    assert Report.from_values({}) == Report()


def test_a_failure_comes_back_as_its_own_class() -> None:
    failure = Report(error_code="ungrounded", error="No cube.", error_hint="Show one.").failure()
    assert isinstance(failure, UngroundedError)
    assert str(failure) == "No cube. Show one."
    assert isinstance(Report(error_code="of the future", error="?").failure(), InternalError)
