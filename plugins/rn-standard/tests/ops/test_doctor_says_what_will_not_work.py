"""`roboneuron doctor` on a sound machine and on broken ones."""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from rn_standard.doctor import checks
from rn_standard.doctor.finding import Finding, Severity, ok
from rn_standard.doctor.images import ImageTransport
from rn_standard.ops.maintenance import MaintenanceFile
from rn_testing.domain import free_ros_domain
from roboneuron.config import Config, parse_config
from roboneuron.errors import ConfigurationError, NotReadyError
from roboneuron.estop import ESTOP_FILE, EmergencyStopLatch
from roboneuron.gate import AuditLog
from roboneuron.plugins.availability import is_importable
from roboneuron.plugins.registry import Status

MIB = 1 << 20
LOADED = functools.cache(checks.installations._loaded)
"""A process that loads rclpy, once for all tests."""


def config_in(state: Path) -> Config:
    return parse_config(f'[robot]\nname = "nobody"\n[supervisor]\nstate_directory = "{state}"\n')


def find(name: str, config: Config) -> Finding:
    return next(finding for check, finding in checks.run_checks(config) if check.id == name)


class Linked:
    """A command of a plugin that knows something of this machine."""

    def __init__(self, *found: tuple[bool, str, str], error: ConfigurationError | None = None):
        self._found, self._error = found, error

    def findings(self) -> tuple[tuple[bool, str, str], ...]:
        if self._error is not None:
            raise self._error
        return self._found


def of_commands(monkeypatch: pytest.MonkeyPatch, command: object, state: Path) -> list[Finding]:
    """What the doctor says of a command that a plugin offers."""
    listed = SimpleNamespace(name="link", words="link", load=lambda: command)
    monkeypatch.setattr(checks, "all_commands", lambda registry: (listed,))
    found = checks.run_checks(config_in(state))
    return [finding for check, finding in found if check.id == "link"]


def test_commands_of_plugins_say_what_they_know_of_this_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    linked = Linked((True, "gpu is connected.", ""), (False, "lab is NOT.", "Is it on?"))
    well, ill = of_commands(monkeypatch, linked, tmp_path)
    assert (well.verdict, well.text, well.hint) == (Severity.OK, "gpu is connected.", "")
    assert (ill.verdict, ill.text, ill.hint) == (Severity.WARNING, "lab is NOT.", "Is it on?")
    assert of_commands(monkeypatch, object(), tmp_path) == []
    broken = Linked(error=ConfigurationError("link.json cannot be read.", hint="Pair again."))
    (failed,) = of_commands(monkeypatch, broken, tmp_path)
    assert (failed.verdict, failed.hint) == (Severity.FAILED, "Pair again.")


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """All checks run in every test; the slow ones are replaced."""
    quick = ImageTransport(sent=20, received=20, median_ms=1.0, worst_ms=2.0, neighbours=())
    monkeypatch.setattr(checks, "measure_image_transport", lambda: quick)
    monkeypatch.setattr(
        checks.shutil, "disk_usage", lambda _: SimpleNamespace(free=1 << 40, total=1 << 40)
    )
    monkeypatch.setattr(checks.peers, "look_around", lambda: ok("Nobody else."))
    monkeypatch.setattr(checks.installations, "_loaded", LOADED)
    kept = tuple(check for check in checks.CHECKS if check.id != "gpu")
    monkeypatch.setattr(checks, "CHECKS", kept)


def test_a_state_directory_that_cannot_be_written_fails(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    finding = find("state", config_in(tmp_path / "file" / "state"))
    assert finding.verdict is Severity.FAILED
    assert str(tmp_path / "file" / "state") in finding.text
    assert "supervisor.state_directory" in finding.hint


def test_little_space_for_shared_memory_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        checks.shutil, "disk_usage", lambda _: SimpleNamespace(free=64 * MIB, total=64 * MIB)
    )
    finding = find("shared-memory", config_in(tmp_path))
    assert finding.verdict is Severity.FAILED
    assert "--shm-size" in finding.hint
    assert find("state", config_in(tmp_path)).verdict is Severity.WARNING


def test_a_latched_emergency_stop_is_told_with_its_cause(tmp_path: Path) -> None:
    assert find("emergency-stop", config_in(tmp_path)).verdict is Severity.OK
    EmergencyStopLatch(tmp_path / ESTOP_FILE, time.time_ns).latch(who="the test", reason="a finger")
    finding = find("emergency-stop", config_in(tmp_path))
    assert finding.verdict is Severity.WARNING
    assert 'the test: "a finger"' in finding.text


def test_a_robot_out_of_service_is_told_before_its_stop(tmp_path: Path) -> None:
    EmergencyStopLatch(tmp_path / ESTOP_FILE, time.time_ns).latch(who="the test", reason="a finger")
    MaintenanceFile(tmp_path).begin("ann", "admin", "oiling", AuditLog.in_directory(tmp_path))
    finding = find("emergency-stop", config_in(tmp_path))
    assert "ann took the robot out of service" in finding.text
    assert "--end" in finding.hint


def test_what_a_driver_runs_on_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rn_robot_fr3")
    config = parse_config('[robot]\nname = "fr3"\ndriver = "simulated"\n')
    for there, told in (
        (("mujoco",), "with mujoco"),
        (("pybullet", "mujoco"), "with pybullet or mujoco"),
    ):

        def here(module: str, there: tuple[str, ...] = there) -> bool:
            # of other modules the truth: the plugins that are found now are kept for later tests
            is_engine = module in ("pybullet", "mujoco")
            return module in there if is_engine else is_importable(module)

        monkeypatch.setattr("roboneuron.plugins.availability.is_importable", here)
        assert f"robot fr3 (simulated {told})" in find("configuration", config).text


@pytest.mark.parametrize(
    ("version", "cuda", "said"),
    [
        ("2.13.0+cu130", "13.0", "torch 2.13.0+cu130 (CUDA 13.0 build) sees no CUDA device."),
        ("2.13.0+cpu", None, "torch 2.13.0+cpu (CPU build) sees no CUDA device."),
    ],
)
def test_the_build_of_torch_is_told_where_there_is_no_gpu(
    version: str, cuda: str | None, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "version.py").write_text(
        f"__version__ = {version!r}\ncuda = {cuda!r}\nhip = None\n"
    )
    found = SimpleNamespace(origin=str(tmp_path / "__init__.py"))
    monkeypatch.setattr(checks.importlib.util, "find_spec", lambda name: found)
    imported: list[str] = []
    no_gpu = SimpleNamespace(cuda=SimpleNamespace(is_available=lambda: False))
    monkeypatch.setattr(
        checks.importlib, "import_module", lambda name: imported.append(name) or no_gpu
    )
    finding = checks._gpu(config_in(tmp_path))
    assert finding.verdict is Severity.WARNING
    assert finding.text == said
    assert ("the CPU build, which is smaller" in finding.hint) == (cuda is not None)
    assert imported == (["torch"] if cuda else [])


def test_a_configuration_that_names_what_is_not_installed_fails(tmp_path: Path) -> None:
    finding = find("configuration", config_in(tmp_path))
    assert finding.verdict is Severity.FAILED
    assert "'nobody'" in finding.text


@pytest.mark.parametrize(
    ("limits", "verdict", "hint"),
    [("collision = false", Severity.WARNING, "Set it to true"), ("", Severity.OK, "")],
)
def test_an_arm_whose_links_are_not_kept_apart_is_told(
    tmp_path: Path, limits: str, verdict: Severity, hint: str
) -> None:
    pytest.importorskip("rn_robot_fr3")
    text = '[robot]\nname = "fr3"\n[supervisor]\nstate_directory = '
    config = parse_config(f'{text}"{tmp_path}"\n[limits]\n{limits}\n')
    (check,) = (check for check in checks.CHECKS if check.id == "distances")
    finding = check.answer(config)
    assert finding.verdict is verdict
    assert hint in finding.hint


@pytest.mark.parametrize(
    ("seen", "verdict", "words"),
    [
        ({"received": 0}, Severity.FAILED, "none arrived"),
        ({"median_ms": 80.0}, Severity.WARNING, "80.0 ms"),
        ({"received": 5}, Severity.WARNING, "5 of 20"),
        (
            {"neighbours": ("/roboneuron_doctor_1", "/fr3/control")},
            Severity.WARNING,
            "1 other nodes",
        ),
    ],
)
def test_images_that_do_not_come_or_come_late_are_told(
    seen: dict[str, object],
    verdict: Severity,
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    good = {"sent": 20, "received": 20, "median_ms": 1.0, "worst_ms": 2.0, "neighbours": ()}
    monkeypatch.setattr(
        checks, "measure_image_transport", lambda: ImageTransport(**{**good, **seen})
    )
    finding = find("images", config_in(tmp_path))
    assert finding.verdict is verdict
    assert words in finding.text


def test_an_error_of_a_check_is_a_finding_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken() -> ImageTransport:
        raise NotReadyError("The process that sends images hung for 20 s.")

    monkeypatch.setattr(checks, "measure_image_transport", broken)
    findings = {check.id: finding for check, finding in checks.run_checks(config_in(tmp_path))}
    assert findings["images"].verdict is Severity.FAILED
    assert "hung" in findings["images"].text
    assert "configuration" in findings


def test_a_check_that_breaks_is_a_finding_and_what_needs_it_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checks.installations, "look", lambda _: 1 / 0)
    monkeypatch.setattr(
        checks, "measure_image_transport", lambda: pytest.fail("ROS cannot be used")
    )
    findings = {check.id: finding for check, finding in checks.run_checks(config_in(tmp_path))}
    assert findings["ros"].verdict is Severity.FAILED
    assert "ZeroDivisionError: division by zero" in findings["ros"].text
    assert findings["images"].verdict is Severity.WARNING
    assert "Not tried: the check 'ros' failed." in findings["images"].text
    assert "configuration" in findings


def foreign_rclpy(folder: Path) -> str:
    (folder / "rclpy").mkdir()
    (folder / "rclpy" / "__init__.py").write_text("raise ImportError('built for another Python')\n")
    return str(folder)


@pytest.mark.parametrize(
    ("variable", "value", "words"),
    [
        ("ROS_DOMAIN_ID", "abc", "ROS_DOMAIN_ID is 'abc', expected a whole number from 0 to 232."),
        pytest.param("ROS_DOMAIN_ID", "300", "ROS_DOMAIN_ID is '300'", marks=pytest.mark.slow),
        pytest.param("ROS_DOMAIN_ID", "-1", "ROS_DOMAIN_ID is '-1'", marks=pytest.mark.slow),
        (
            "RMW_IMPLEMENTATION",
            "rmw_nope_cpp",
            "RMW_IMPLEMENTATION is 'rmw_nope_cpp', which is not installed",
        ),
        ("PYTHONPATH", "foreign", "rclpy would be imported from"),
        ("PYTHONIOENCODING", "ascii", ""),
    ],
)
def test_the_command_survives_what_it_is_for(
    variable: str, value: str, words: str, tmp_path: Path
) -> None:
    config = tmp_path / "roboneuron.toml"
    config.write_text(
        f'[robot]\nname = "nobody"\n[supervisor]\nstate_directory = "{tmp_path / "state"}"\n'
    )
    environment = {**os.environ, "ROS_DOMAIN_ID": str(free_ros_domain())}
    if variable == "PYTHONIOENCODING":
        environment["RMW_IMPLEMENTATION"] = "rmw_nope_cpp"  # so that it need not wait for ROS
    environment[variable] = foreign_rclpy(tmp_path) if value == "foreign" else value
    command = [sys.executable, "-P", "-m", "roboneuron.cli.main", "doctor", "--config", str(config)]
    done = subprocess.run(
        command, capture_output=True, encoding="utf-8", timeout=120, check=False, env=environment
    )
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert words in done.stdout
    assert "no robot 'nobody'" in done.stdout  # the checks after it were made
    assert done.stdout.isascii() == (variable == "PYTHONIOENCODING")


@pytest.mark.exhaustive
@pytest.mark.ros
def test_the_command_looks_at_the_real_machine(tmp_path: Path) -> None:
    config = tmp_path / "roboneuron.toml"
    config.write_text(
        f'[robot]\nname = "nobody"\n[supervisor]\nstate_directory = "{tmp_path / "state"}"\n'
    )
    environment = {**os.environ, "ROS_DOMAIN_ID": str(free_ros_domain())}
    command = [
        sys.executable,
        "-P",
        "-m",
        "roboneuron.cli.main",
        "doctor",
        "--json",
        "--config",
        str(config),
    ]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=90, check=False, env=environment
    )
    findings = {f["id"]: f for f in json.loads(done.stdout)["findings"]}
    assert done.returncode == 1
    assert findings["configuration"]["verdict"] == "failed"
    assert "images of 640x480 arrived" in findings["images"]["text"]
    assert findings["ros"]["verdict"] == findings["interpreter"]["verdict"] == "ok"


@pytest.mark.parametrize(
    ("status", "severity"),
    [
        (Status.READY, Severity.OK),
        (Status.DISABLED, Severity.OK),
        (Status.UNAVAILABLE, Severity.OK),  # an optional one whose library nobody installed
        (Status.INCOMPATIBLE, Severity.WARNING),
        (Status.CONFLICT, Severity.WARNING),
        (Status.FAILED, Severity.WARNING),
    ],
)
def test_a_plugin_that_lacks_its_library_is_named_and_no_fault(
    status: Status, severity: Severity, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    records = [
        SimpleNamespace(name="good", status=Status.READY),
        SimpleNamespace(name="other", status=status),
    ]
    monkeypatch.setattr(checks, "discover", lambda *_: SimpleNamespace(plugins=records))
    found = find("plugins", config_in(tmp_path))
    assert found.verdict is severity
    assert ("other" in found.text) == (status not in (Status.READY, Status.DISABLED))
