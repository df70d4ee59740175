"""`roboneuron robot fr3 check` names what a machine or a network lacks, with limits, and fails with
its own exit status.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pytest

from rn_robot_fr3.fci import check
from rn_robot_fr3.fci.check import ArmFinding, SystemFiles, Timing, check_machine
from rn_robot_fr3.fci.check_command import Fr3
from rn_robot_fr3.fci.network_check import card, checksum, judged_fci, judged_round_trips

ON_TIME = Timing(late_s=np.full(1000, 5e-5))


def machine(root: Path, **files: str) -> SystemFiles:
    """A machine with these files; "__" stands for "/"."""
    for name, text in files.items():
        path = root / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")
    return SystemFiles(root)


def found(findings: list[ArmFinding], name: str) -> ArmFinding:
    return next(finding for finding in findings if finding.name == name)


@pytest.mark.parametrize(("flag", "verdict"), [("1", "ok"), ("0", "failed")])
def test_only_a_realtime_kernel_will_do(tmp_path: Path, flag: str, verdict: str) -> None:
    made = machine(tmp_path, sys__kernel__realtime=flag, proc__sys__kernel__osrelease="6.1-rt")
    kernel = found(check_machine(made, 0.1, lambda _: ON_TIME), "kernel")
    assert kernel.verdict == verdict
    assert "PREEMPT_RT" in kernel.found + kernel.hint
    assert "6.1-rt" in kernel.found


def test_power_saving_of_the_processor_is_named(tmp_path: Path) -> None:
    cpu = "sys__devices__system__cpu__"
    made = machine(
        tmp_path,
        **{
            f"{cpu}cpu0__cpufreq__scaling_governor": "powersave",
            f"{cpu}cpu0__cpuidle__state1__latency": "800",
            f"{cpu}cpu0__cpuidle__state1__disable": "0",
        },
    )
    findings = check_machine(made, 0.1, lambda _: ON_TIME)
    assert "powersave, wanted: performance" in found(findings, "governor").found
    assert "800 us" in found(findings, "idle-states").found
    quiet = machine(tmp_path, **{f"{cpu}cpu0__cpuidle__state1__disable": "1"})
    assert found(check_machine(quiet, 0.1, lambda _: ON_TIME), "idle-states").verdict == "ok"


@pytest.mark.parametrize(
    ("late_ms", "verdict"),
    [([0.05] * 1000, "ok"), ([0.4] * 2 + [0.0] * 998, "failed"), ([0.0] * 999 + [11], "failed")],
)
def test_cycles_that_begin_late_are_counted(
    tmp_path: Path, late_ms: list[float], verdict: str
) -> None:
    timing = Timing(late_s=np.array(late_ms) / 1e3)
    cycles = found(check_machine(SystemFiles(tmp_path), 1.0, lambda _: timing), "cycles")
    assert cycles.verdict == verdict
    assert f"{timing.missed} of 1000" in cycles.found


@pytest.mark.parametrize(
    ("times_ms", "verdict"),
    [
        ([0.2] * 100, "ok"),
        ([0.4] * 100, "failed"),
        ([0.2] * 99 + [1.5], "failed"),
        ([0.2] * 99 + [np.inf], "failed"),
    ],
)
def test_round_trips_have_limits(times_ms: list[float], verdict: str) -> None:
    assert judged_round_trips([value / 1e3 for value in times_ms]).verdict == verdict


def test_an_unmeasured_round_trip_is_a_warning() -> None:
    assert judged_round_trips("echo requests are not allowed here").verdict == "warning"


def test_the_card_towards_the_robot_is_wired_and_awake(tmp_path: Path) -> None:
    route = "Iface Destination Gateway Flags RefCnt Use Metric Mask MTU Window IRTT\n"
    route += (
        "eth0 00000000 010010AC 3 0 0 0 00000000 0 0 0\nenp3s0 000010AC 00000000 1 0 0 0 "
        "0000FFFF 0 0 0"
    )
    made = machine(
        tmp_path,
        proc__net__route=route,
        sys__class__net__enp3s0__speed="100",
        sys__class__net__enp3s0__device__power__control="auto",
    )
    assert made.interface("172.16.0.2") == "enp3s0"
    assert made.interface("8.8.8.8") == "eth0"
    told = card(made, "172.16.0.2")
    assert (told.verdict, "100 Mbit/s" in told.found, "power saving" in told.found) == (
        "warning",
        True,
        True,
    )
    assert card(made, "127.0.0.1").verdict == "ok"


def test_a_checksum_verifies() -> None:
    data = bytes(range(32))
    assert checksum(data + checksum(data).to_bytes(2, "big")) == 0


def test_the_command_fails_when_a_finding_does(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = ArmFinding(
        name="kernel", verdict="failed", found="not real-time", hint="Boot another one."
    )
    monkeypatch.setattr(check, "check_machine", lambda *_: [bad])
    parser = argparse.ArgumentParser()
    command = Fr3()
    command.configure(parser)
    assert command.run(parser.parse_args(["check"])) == 1
    told = capsys.readouterr().out
    assert "✗ kernel: not real-time\n    Boot another one." in told
    assert "Not fit for a real arm: kernel." in told
    assert command.run(parser.parse_args(["check", "--json"])) == 1
    assert json.loads(capsys.readouterr().out)[0]["verdict"] == "failed"


def test_an_fci_that_is_not_active_is_named() -> None:
    told = judged_fci("127.77.0.9")
    assert told.verdict == "failed"
    assert "Activate FCI in Desk" in told.hint
