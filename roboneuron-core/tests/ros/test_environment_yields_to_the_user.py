"""Defaults for ROS wheels are only set where the user has set nothing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from roboneuron.errors import ConfigurationError
from roboneuron.ros.environment import (
    BOOTSTRAP_GUARD,
    PARTICIPANTS,
    PORT_OFFSET,
    fast_dds_profile,
    module_environment,
    port_offset,
    set_defaults,
)

PREFIX = "/venv"


def defaults(**given: str) -> dict[str, str]:
    environment = dict(given)
    set_defaults(environment, prefix=PREFIX, log_directory=Path("logs"))
    return environment


def test_an_empty_environment_gets_every_default() -> None:
    environment = defaults()
    assert environment["AMENT_PREFIX_PATH"] == PREFIX
    assert environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
    assert environment["FASTRTPS_DEFAULT_PROFILES_FILE"] == str(fast_dds_profile())
    assert environment["ROS_LOG_DIR"] == "logs"
    assert environment[PORT_OFFSET] == "11"
    assert environment[PARTICIPANTS] == "32"


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("AMENT_PREFIX_PATH", "/venv:/overlay"),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET"),
        ("FASTRTPS_DEFAULT_PROFILES_FILE", "mine.xml"),
        ("ROS_LOG_DIR", "elsewhere"),
    ],
)
def test_what_the_user_set_stays(key: str, value: str) -> None:
    assert defaults(**{key: value})[key] == value


@pytest.mark.parametrize("key", ["ROS_DISCOVERY_SERVER", "ROS_STATIC_PEERS", "ROS_LOCALHOST_ONLY"])
def test_discovery_range_is_left_alone_when_discovery_is_configured_otherwise(key: str) -> None:
    assert "ROS_AUTOMATIC_DISCOVERY_RANGE" not in defaults(**{key: "x"})


def test_profile_is_left_alone_when_transports_are_configured_otherwise() -> None:
    assert "FASTRTPS_DEFAULT_PROFILES_FILE" not in defaults(FASTDDS_BUILTIN_TRANSPORTS="UDPv4")


@pytest.mark.parametrize("domain", ["abc", "-1", "233", "300", "1.0", "\u0661"])
def test_a_domain_for_which_rcl_would_end_the_process_is_refused(domain: str) -> None:
    with pytest.raises(
        ConfigurationError, match=r"ROS_DOMAIN_ID is .*expected a whole number from 0 to 232"
    ):
        defaults(ROS_DOMAIN_ID=domain)


@pytest.mark.parametrize("domain", ["", "0", "232"])
def test_a_domain_that_exists_is_taken(domain: str) -> None:
    assert defaults(ROS_DOMAIN_ID=domain)["ROS_DOMAIN_ID"] == domain


def test_a_middleware_that_is_not_installed_is_refused(tmp_path: Path) -> None:
    index = tmp_path / "share" / "ament_index" / "resource_index" / "rmw_typesupport"
    index.mkdir(parents=True)
    for name in ("rmw_implementation", "rmw_one_cpp"):
        (index / name).touch()
    for name in ("rmw_two_cpp", "rmw_implementation"):
        with pytest.raises(
            ConfigurationError,
            match=f"'{name}', which is not installed.*choose one of: rmw_one_cpp",
        ):
            set_defaults({"RMW_IMPLEMENTATION": name}, prefix=str(tmp_path), log_directory=tmp_path)
    set_defaults(
        {"RMW_IMPLEMENTATION": "rmw_one_cpp"}, prefix=str(tmp_path), log_directory=tmp_path
    )


def test_modules_get_no_tokens(monkeypatch: pytest.MonkeyPatch) -> None:
    for key in ("CHIEF", "ROBONEURON_TOKEN", "OTHER"):
        monkeypatch.setenv(key, "x")
    for python in (None, "/elsewhere/bin/python"):
        environment = module_environment(python, 0, ["CHIEF", "NOT_SET"])
        assert "OTHER" in environment
        assert not {"CHIEF", "ROBONEURON_TOKEN"} & set(environment)


def test_shipped_profile_has_a_32_mib_segment() -> None:
    sizes = [
        e.text
        for e in ElementTree.parse(fast_dds_profile()).iter()
        if e.tag.endswith("segment_size")
    ]
    assert sizes == [str(32 * 2**20)]


def test_another_interpreter_does_not_inherit_our_libraries(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for key in (BOOTSTRAP_GUARD, "LD_LIBRARY_PATH", "AMENT_PREFIX_PATH"):
        monkeypatch.setenv(key, "x")
    assert "LD_LIBRARY_PATH" in module_environment(None, 0)
    other = module_environment("/elsewhere/bin/python", 0)
    assert not {BOOTSTRAP_GUARD, "LD_LIBRARY_PATH", "AMENT_PREFIX_PATH"} & set(other)


def test_successive_modules_have_ports_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    offsets = [int(module_environment(None, start)[PORT_OFFSET]) for start in range(100, 115)]
    ports = [offset + 2 * participant for offset in offsets for participant in range(16)]
    assert len(set(ports)) == len(ports)
    assert all(port % 250 > 11 + 2 * 59 for port in ports)


@pytest.mark.parametrize("domain", [0, 101, 227, 229, 230, 231, 232])
def test_ports_exist_in_every_domain(domain: int) -> None:
    offsets = {port_offset(domain, start) for start in range(15)}
    assert all(7400 + 250 * domain + offset + 2 * 15 < 2**16 for offset in offsets)
    assert len(offsets) == 15 or domain > 227


_IMPORTS_A_MESSAGE = """
import sys
import subprocess
import sys
from pathlib import Path
from roboneuron.ros.environment import prepare_environment
prepare_environment(Path(sys.argv[1]))
from std_msgs.msg import Header
type(Header).__import_type_support__()
print("lark" in sys.modules, Header._TYPE_SUPPORT is not None)
"""


def test_messages_are_imported_without_the_generator_that_wrote_them(tmp_path: Path) -> None:
    command = [sys.executable, "-c", _IMPORTS_A_MESSAGE, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.split() == ["False", "True"]


_GENERATES = """
import sys
from pathlib import Path
from roboneuron.ros.environment import prepare_environment
prepare_environment(Path(sys.argv[1]))
from std_msgs.msg import Header
from rosidl_generator_py import generate_py
for _ in range(2):
    try:
        generate_py(sys.argv[2], [])
    except FileNotFoundError as error:
        print(error.filename)
from rosidl_generator_py.generate_py_impl import primitive_value_to_py
"""


def test_the_generator_is_there_for_who_calls_it(tmp_path: Path) -> None:
    missing = str(tmp_path / "arguments.json")
    command = [sys.executable, "-c", _GENERATES, str(tmp_path), missing]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.split() == [missing, missing]
