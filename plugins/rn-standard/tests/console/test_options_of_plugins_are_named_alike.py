"""`--option` has one notation in all commands that take it."""

from __future__ import annotations

import pytest

from rn_standard.console.parsers import _actions, whole_parser
from rn_standard.console.plugin_options import FORM, read_options
from roboneuron.errors import ConfigurationError


def test_values_are_toml_or_json_or_text():
    texts = [
        "gain=0.5",
        "path=/tmp/x",
        'name="a b"',
        "sizes=[1, 2]",
        "on=true",
        "none=null",
        'table={"a": 1}',
    ]
    expected = {
        "gain": 0.5,
        "path": "/tmp/x",
        "name": "a b",
        "sizes": [1, 2],
        "on": True,
        "none": None,
    }
    assert read_options([*texts, "day=2026-01-02"], "x")["x"] == {
        **expected,
        "table": {"a": 1},
        "day": "2026-01-02",
    }


def test_a_name_without_plugin_is_an_option_of_what_the_command_is_about():
    texts = ["gain=1", "torch.device=cpu", "servo.gain=2"]
    assert read_options(texts, "servo") == {"servo": {"gain": 2}, "torch": {"device": "cpu"}}


@pytest.mark.parametrize("text", ["gain", "=1", ".gain=1", "servo.=1", "two words=1"])
def test_another_form_is_refused_with_an_example(text):
    with pytest.raises(
        ConfigurationError, match=r"expected \[PLUGIN\.\]NAME=VALUE.*servo\.gain=0\.5"
    ):
        read_options([text], "servo")


def test_every_command_that_takes_option_takes_this_form():
    found = [action for action in _actions(whole_parser()) if "--option" in action.option_strings]
    assert found
    assert {action.metavar for action in found} == {FORM}
