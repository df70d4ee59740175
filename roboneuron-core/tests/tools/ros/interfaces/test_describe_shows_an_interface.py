"""`roboneuron ros describe`: text for people, schemas for programs, one sentence for mistakes."""

from __future__ import annotations

import json

import pytest

from roboneuron.cli.main import main


def test_a_message_is_shown_with_types_bounds_and_choices(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["ros", "describe", "sensor_msgs/NavSatFix"]) == 0
    text = capsys.readouterr().out
    assert "sensor_msgs/msg/NavSatFix (message)" in text
    assert "position_covariance: double[9]" in text
    assert "COVARIANCE_TYPE_KNOWN=3" in text


def test_a_service_is_shown_in_both_halves(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["ros", "describe", "std_srvs/srv/SetBool", "--json"]) == 0
    schemas = json.loads(capsys.readouterr().out)
    assert set(schemas) == {"request", "response"}
    assert schemas["request"]["required"] == ["data"]


def test_the_installed_interfaces_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["ros", "describe", "--list", "std_srvs"]) == 0
    assert capsys.readouterr().out.split() == [
        "std_srvs/srv/Empty",
        "std_srvs/srv/SetBool",
        "std_srvs/srv/Trigger",
    ]


@pytest.mark.parametrize("words", [["geometry_msgs/Twits"], [], ["--list", "nothing"], ["../etc"]])
def test_mistakes_end_in_one_sentence(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["ros", "describe", *words]) == 2
    assert capsys.readouterr().err.startswith("roboneuron: ")
