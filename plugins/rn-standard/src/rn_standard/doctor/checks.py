"""Checks of `roboneuron doctor`, in the order of their dependencies."""

from __future__ import annotations

import importlib
import importlib.util
import os
import platform
import runpy
import shutil
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from rn_standard.doctor import installations, peers
from rn_standard.doctor.finding import (
    Check,
    Examining,
    Finding,
    Severity,
    failed,
    ok,
    warning,
)
from rn_standard.doctor.images import measure_image_transport
from rn_standard.ops.maintenance import MaintenanceFile
from roboneuron import RoboNeuronError, RobotSpec, install_command
from roboneuron.command import (
    Status,
    all_commands,
    availability,
    discover,
    environment,
)
from roboneuron.feature import Config, Registry, estop

MIN_SHARED_MEMORY_MIB = 256
"""Required shared memory: a segment of 32 MiB for each of the five processes, and as much again for
a switch and for other programs.
"""
MIN_DISK_MIB = 100
LATE_MS = 20.0
"""Latency above which images count as late; a 640x480 image takes about 2 ms between processes on
an idle laptop.
"""
_MIB = 1 << 20


def run_checks(config: Config) -> Iterator[tuple[Check, Finding]]:
    """Yield each check with its finding; an error is a finding too."""
    lost = set()
    for check in CHECKS:
        if check.needs in lost:
            yield (
                check,
                warning(
                    f"{check.question} Not tried: the check {check.needs!r} failed.",
                    "Mend that first.",
                ),
            )
            continue
        finding = _answer(check, config)
        if finding.verdict is Severity.FAILED:
            lost.add(check.id)
        yield check, finding
    yield from _of_commands(config)


def _of_commands(config: Config) -> Iterator[tuple[Check, Finding]]:
    """Findings of plugins' commands that have a method `findings`; see `Examining`."""
    commands = all_commands(discover(config.disabled_plugins))
    for listed in sorted(commands, key=lambda one: one.name):
        try:
            command = listed.load()
            if not isinstance(command, Examining):
                continue
            found = [
                ok(text) if is_well else warning(text, hint)
                for is_well, text, hint in command.findings()
            ]
        except RoboNeuronError as error:
            found = [failed(error.message, error.hint)]
        for finding in found:
            question = f"Is all well with `roboneuron {listed.words}`?"
            yield Check(id=listed.name, question=question, answer=partial(_told, finding)), finding


def _told(finding: Finding, _: Config) -> Finding:
    return finding


def _answer(check: Check, config: Config) -> Finding:
    try:
        return check.answer(config)
    except RoboNeuronError as error:
        return failed(error.message, error.hint)
    except Exception as error:  # the examined part may be broken in any way
        words = str(error).strip().splitlines() or ["no message"]
        return failed(
            f"{check.question} {type(error).__name__}: {words[0]}", "Look at what this names."
        )


def _interpreter(_: Config) -> Finding:
    text = (
        f"Python {platform.python_version()} on {platform.system()} {platform.machine()}, "
        f"{os.cpu_count()} cores."
    )
    if platform.system() != "Linux" or sys.version_info < (3, 11):
        return failed(
            text,
            "The ROS wheels are for Linux (x86-64, glibc 2.28 or newer) and Python 3.11 or newer.",
        )
    return ok(text)


def _state(config: Config) -> Finding:
    directory = environment.state_directory(config.supervisor.state_directory)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory) as probe:
            probe.write(b"x")
    except OSError as error:
        return failed(
            f"The state directory {directory} cannot be written: {error.strerror}.",
            "Logs, audit and the emergency stop's latch live there: without it nothing may move. "
            "Set "
            "supervisor.state_directory or XDG_STATE_HOME to a directory of yours.",
        )
    free_mib = shutil.disk_usage(directory).free // _MIB
    if free_mib < MIN_DISK_MIB:
        return warning(
            f"{directory} has {free_mib} MiB left.",
            "A full disk stops motion: the audit must be written.",
        )
    return ok(f"{directory} is writable, {free_mib} MiB free.")


def _emergency_stop(config: Config) -> Finding:
    """What forbids motion with and without a server: files of the state directory."""
    directory = environment.state_directory(config.supervisor.state_directory)
    out_of_service = MaintenanceFile(directory).read()
    if out_of_service is not None:
        reason = out_of_service.still_reason()
        return warning(reason.message, reason.hint)
    latch = estop.EmergencyStopLatch.in_directory(directory)
    latched = latch.still_reason()
    if latched is not None:
        return warning(latched.message, f"Look at the robot, then: {latch.release_command}")
    return ok("The emergency stop is not latched, and the robot is in service.")


def _shared_memory(_: Config) -> Finding:
    path = Path("/dev/shm")
    if not path.is_dir():
        return failed(
            "There is no /dev/shm.",
            "Images travel in shared memory; in a container, mount a tmpfs there.",
        )
    usage = shutil.disk_usage(path)
    text = f"/dev/shm has {usage.free // _MIB} of {usage.total // _MIB} MiB free."
    if usage.free < MIN_SHARED_MEMORY_MIB * _MIB:
        return failed(
            text,
            f"Each process takes a segment of 32 MiB; {MIN_SHARED_MEMORY_MIB} MiB are wanted. In "
            "a container: "
            "--shm-size=1g. Left over from killed processes: files fastrtps_* that no process "
            "holds (fuser tells).",
        )
    return ok(text)


def _ros(config: Config) -> Finding:
    if importlib.util.find_spec("rclpy") is None:
        return failed(
            "rclpy is not installed.",
            "It comes with roboneuron-core: is this the environment that it is installed in?",
        )
    return installations.look(environment.prepare_environment(wanted=config.ros.installation))


def _images(_: Config) -> Finding:
    environment.prepare_environment()
    seen = measure_image_transport()
    if not seen.received:
        return failed(
            f"Of {seen.sent} images sent by another process, none arrived.",
            "Discovery fails or shared memory cannot be used. Unset ROS_*, FASTDDS_* and "
            "FASTRTPS_* variables that "
            "this shell has set, and look whether a firewall blocks UDP on the loopback interface.",
        )
    text = (
        f"{seen.received} of {seen.sent} images of 640x480 arrived from another process, "
        f"{seen.median_ms:.1f} ms old (median), {seen.worst_ms:.1f} ms at worst."
    )
    if seen.median_ms > LATE_MS or seen.received < seen.sent // 2:
        return warning(
            text,
            "Is the machine busy? Otherwise images go over UDP: see "
            "FASTRTPS_DEFAULT_PROFILES_FILE.",
        )
    others = [name for name in seen.neighbours if not name.startswith("/roboneuron_doctor")]
    if others:
        shown = ", ".join(sorted(others)[:5])
        return warning(
            f"{text} {len(others)} other nodes share this domain: {shown}.",
            "That is fine for a robot's own nodes; otherwise choose another ROS_DOMAIN_ID.",
        )
    return ok(text)


def _peers(_: Config) -> Finding:
    environment.prepare_environment()
    return peers.look_around()


def _plugins(config: Config) -> Finding:
    records = discover(config.disabled_plugins).plugins
    ready = sum(record.status is Status.READY for record in records)
    text = f"{ready} of {len(records)} plugins are ready."
    if not ready:
        return failed(text, f"For a start: {install_command()}")
    # whether the chosen ones are usable is a check of its own
    lacking = [r.name for r in records if r.status is Status.UNAVAILABLE]
    if lacking:
        text += f" Without the libraries that they need: {', '.join(lacking)}."
    faulty = [
        r.name
        for r in records
        if r.status not in (Status.READY, Status.DISABLED, Status.UNAVAILABLE)
    ]
    if faulty:
        return warning(
            f"{text} At fault: {', '.join(faulty)}.", "roboneuron plugins list says why."
        )
    return ok(text)


def _configuration(config: Config) -> Finding:
    from roboneuron.command import check_configuration  # pydantic and plugins' options, not mcp

    registry = discover(config.disabled_plugins, config.robot)
    check_configuration(config, registry)
    names = [f"robot {config.robot.name} ({config.robot.driver}{_chosen(config, registry)})"]
    names += [f"perception {config.perception.source}"] if config.perception else []
    names += [f"control {config.control.controller}"] if config.control else []
    names += [f"inference {config.inference.backend}"] if config.inference else []
    return ok(f"What it names is installed and fits together: {', '.join(names)}.")


def _distances(config: Config) -> Finding:
    from roboneuron.modules.arm_paths import UncheckedPaths  # numpy

    told = UncheckedPaths().why(config, discover(config.disabled_plugins, config.robot))
    if not told:
        return ok("They are checked, or the robot has no arm.")
    why, _, how = told.partition(". ")
    return warning(f"{why}.", how)


def _chosen(config: Config, registry: Registry) -> str:
    """Installed modules that the robot's driver can choose from; by default it uses the first."""
    driver = registry.get(RobotSpec, config.robot.name).driver(config.robot.driver)
    choices = (
        [
            availability.present(requirement)
            for requirement in driver.requires
            if requirement.alternatives
        ]
        if driver
        else []
    )
    return "".join(f" with {' or '.join(modules)}" for modules in choices)


def _gpu(_: Config) -> Finding:
    found = importlib.util.find_spec("torch")
    if found is None or found.origin is None:
        return ok("torch is not installed: model backends cannot run, visual servoing needs none.")
    # this file alone: PyTorch itself takes seconds to import, and its CPU build sees no GPU anyway
    built = runpy.run_path(str(Path(found.origin).with_name("version.py")))
    version, cuda = built["__version__"], built.get("cuda")
    build = f"CUDA {cuda} build" if cuda else "ROCm build" if built.get("hip") else "CPU build"
    if build != "CPU build":
        torch = importlib.import_module("torch")
        if torch.cuda.is_available():
            properties = torch.cuda.get_device_properties(0)
            return ok(
                f"torch {version} ({build}) on {properties.name}, "
                f"{properties.total_memory // _MIB} MiB."
            )
    small = " Without a GPU the CPU build, which is smaller, does the same." if cuda else ""
    return warning(
        f"torch {version} ({build}) sees no CUDA device.",
        "Models of billions of parameters take seconds for an action on a CPU. With an NVIDIA "
        "GPU: nvidia-smi "
        f"must list it, and torch must be a CUDA build.{small} README.md, PyTorch, says how "
        "to choose.",
    )


CHECKS = (
    Check(id="interpreter", question="Is this a system RoboNeuron runs on?", answer=_interpreter),
    Check(id="state", question="Can logs, audit and latch be written?", answer=_state),
    Check(id="emergency-stop", question="May the robot move?", answer=_emergency_stop),
    Check(id="shared-memory", question="Is there room for images?", answer=_shared_memory),
    Check(id="ros", question="Is ROS 2 there?", answer=_ros),
    Check(
        id="images", question="Do images get from process to process?", answer=_images, needs="ros"
    ),
    Check(
        id="peers",
        question="Do all on the graph understand each other?",
        answer=_peers,
        needs="ros",
    ),
    Check(id="plugins", question="Are the plugins ready?", answer=_plugins),
    Check(
        id="configuration", question="Does the configuration fit together?", answer=_configuration
    ),
    Check(
        id="distances",
        question="Are an arm's links kept away from each other?",
        answer=_distances,
        needs="configuration",
    ),
    Check(id="gpu", question="What do models run on?", answer=_gpu),
)
