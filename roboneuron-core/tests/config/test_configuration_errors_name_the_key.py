"""roboneuron.toml: errors name file, key and the nearest valid key."""

from __future__ import annotations

from pathlib import Path

import pytest

from rn_testing.fakes import FAKE_ROBOT, fake_registry
from roboneuron.config import load_config, parse_config
from roboneuron.errors import ConfigurationError, nearest
from roboneuron.plugins.registry import Registry

MINIMAL = '[robot]\nname = "arm"\n'


def test_embedded_default_is_valid() -> None:
    config = load_config()
    assert config.inference is not None
    assert config.perception is not None
    assert config.control is not None


def test_namespace_is_the_robot_name_unless_given() -> None:
    assert parse_config('[robot]\nname = "my-arm"\n').namespace == "my_arm"
    assert (
        parse_config('[robot]\nname = "my-arm"\nnamespace = "cell/left"\n').namespace == "cell/left"
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "[robot]\nname='arm'\ncommand_timeout_ms = 300",
            "'robot.command_timeout_ms'. Did you mean 'command_timeout_s'",
        ),
        (MINIMAL + "[contrl]\n", "'contrl'. Did you mean 'control'"),
        (
            MINIMAL + "[control]\ncontroller='x'\naction_timeout = 1.0",
            "Did you mean 'action_timeout_s'",
        ),
        (
            MINIMAL + "[control]\ncontroller='x'\naction_timeout_s = 0.0",
            "action_timeout_s = 0.0: input should be greater",
        ),
        (
            MINIMAL + "[control]\ncontroller='x'\naction_timeout_s = '1 s'",
            "control.action_timeout_s = '1 s'",
        ),
        (
            MINIMAL + "[control]\ncontroller='x'\ncommand = 'torque'",
            "'joint_trajectory' or 'joint_state'",
        ),
        (MINIMAL + "[inference]\nbackend = 'Not A Name'", "inference.backend = 'Not A Name'"),
        ("[robot]\ndriver = 'simulated'", "'robot.name' is missing"),
        ("[robot\n", "is not valid TOML"),
        ("[robot]\nname='arm'\nnamespace='../up'", "robot.namespace = '../up'"),
    ],
)
def test_error_names_file_key_and_what_is_valid(text: str, expected: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        parse_config(text, source="lab.toml")
    assert str(caught.value).startswith("lab.toml")
    assert expected in str(caught.value)


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("action_timeout_s = 1.0\n", "[control]"),  # [robot] is the table before it
        ("[server]\nstate_directory = 'x'\n", "[supervisor]"),  # of core
        ("[server]\nrecord = true\n", "[recorder]"),  # of a feature with one section
        ("[http]\nmax_step_m = 0.1\n", "[limits]"),  # in a feature's section
        ("[server]\nport = 1\n", "[http], [metrics], [view]"),
        ("[server]\nname = 'x'\nzzz = 1\n", None),
    ],
)
def test_a_key_in_the_wrong_section_is_answered_with_the_right_one(
    text: str, place: str | None
) -> None:
    with pytest.raises(ConfigurationError) as caught:
        parse_config('[robot]\nname = "fr3"\n' + text)
    assert ("is a key of" in caught.value.hint) == (place is not None)
    assert place is None or f"is a key of {place}." in caught.value.hint


def test_names_that_only_share_letters_are_not_suggested() -> None:
    with pytest.raises(ConfigurationError) as caught:
        parse_config(MINIMAL + "[inference]\nbackend = 'servo'\noptions = { gain = 1 }\n")
    assert "Did you mean" not in str(caught.value)
    assert "Valid keys: acceleration," in str(caught.value)
    assert "Options of a plugin stand under [plugins.<name>]." in str(caught.value)


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("timeout", "timeout_s"),
        ("ackend", "backend"),
        ("bakcend", "backend"),
        ("tolerance", "path_tolerance"),
        ("controler", "control"),
    ],
)
def test_typing_errors_and_parts_of_names_are_suggested(typed: str, meant: str) -> None:
    assert (
        nearest(typed, ["python", "backend", "timeout_s", "path_tolerance", "control", "colours"])
        == f"Did you mean {meant!r}?"
    )


@pytest.mark.parametrize(
    ("typed", "known"), [("port", "transport"), ("controler", "colours"), ("options", "python")]
)
def test_names_that_are_no_typing_error_are_not_suggested(typed: str, known: str) -> None:
    assert nearest(typed, [known], likeness=0.5) == ""


@pytest.mark.parametrize(
    ("key", "given", "meant"),
    [
        ("driver", "ros2_control", "ros2-control"),
        ("name", "FR3", "fr3"),
        ("name", "my arm", "my-arm"),
        ("driver", " oft_", "oft"),
        ("name", "9arm", None),
        ("name", "x" * 60 + "!", None),
    ],
)
def test_a_name_of_another_form_gets_its_form_and_a_spelling(
    key: str, given: str, meant: str | None
) -> None:
    robot = {"name": "arm", key: given}
    text = "[robot]\n" + "\n".join(f'{name} = "{value}"' for name, value in robot.items())
    with pytest.raises(ConfigurationError) as caught:
        parse_config(text)
    told = str(caught.value)
    assert "a-z, 0-9" in told
    assert ("Did you mean" in told) == (meant is not None)
    assert meant is None or repr(meant) in told
    assert "^[a-z]" not in told
    assert len(told) < 400


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[supervisor]\nstop_timeout_s = 3\n", "no robot is named"),
        ("[view]\nenabled = true\n", "unknown key 'view'"),
        ("[controler]\ncontroller = 'ik'\n", "unknown key 'controler'"),
        ("controler = 1\n", "unknown key 'controler'"),
        ("", "no robot is named"),
    ],
)
def test_tables_without_a_robot_are_explained_by_what_is_there(text: str, named: str) -> None:
    registry = fake_registry(FAKE_ROBOT)
    with pytest.raises(ConfigurationError) as caught:
        parse_config(text, registry=registry)
    assert named in str(caught.value)
    assert FAKE_ROBOT.name in caught.value.hint


def test_every_error_is_reported_at_once() -> None:
    with pytest.raises(ConfigurationError) as caught:
        parse_config("[robot]\nnam = 'arm'\nstate_rate_hz = 1\n")
    assert "'robot.nam'" in str(caught.value)
    assert "state_rate_hz" in str(caught.value)


def test_missing_file_is_a_configuration_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"There is no file /.*roboneuron config show > "):
        load_config(tmp_path / "absent.toml")


def test_integers_are_accepted_where_seconds_are_meant() -> None:
    config = parse_config(MINIMAL + "[control]\ncontroller='x'\naction_timeout_s = 1\n")
    assert config.control is not None
    assert config.control.action_timeout_s == 1.0


def test_a_section_may_say_how_long_its_module_may_start() -> None:
    text = '[robot]\nname = "fr3"\n[inference]\nbackend = "openvla"\n'
    assert parse_config(text).start_timeout_s("inference") == 60.0
    assert parse_config(text + "start_timeout_s = 30.0\n").start_timeout_s("inference") == 30.0
    assert (
        parse_config(text + "[supervisor]\nstart_timeout_s = 5.0\n").start_timeout_s("control")
        == 5.0
    )


def test_a_section_of_a_feature_that_is_not_installed_names_its_package() -> None:
    with pytest.raises(
        ConfigurationError,
        match=r"'ops': There is no feature 'ops' installed; .* rn-standard brings it",
    ) as caught:
        parse_config(MINIMAL + "[ops]\n", registry=Registry(plugins=(), all_offers=()))
    assert "pip install -r requirements.txt" in caught.value.hint
