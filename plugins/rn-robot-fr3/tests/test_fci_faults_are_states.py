"""Every fault of the arm has one code and a remedy; the driver refuses motion until a person has
recovered it.
"""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from rn_robot_fr3.fci import faults
from rn_robot_fr3.fci.arm import ClientError
from rn_robot_fr3.fci.driver import FciDriver
from rn_robot_fr3.fci.options import FciDriverOptions
from rn_robot_fr3.profile import profile
from rn_testing.fakes import MemoryTopics
from roboneuron import ConfigurationError, NotReadyError


@pytest.mark.parametrize(
    ("mode", "errors", "code"),
    [
        ("UserStopped", (), "user_stop"),
        ("Guiding", (), "guiding"),
        ("Other", (), "brakes_locked"),
        ("AutomaticErrorRecovery", (), "recovering"),
        ("Reflex", ("joint_motion_generator_velocity_discontinuity",), "commands_disordered"),
        ("Reflex", ("cartesian_reflex",), "reflex"),
        ("Reflex", ("joint_position_limits_violation",), "joint_limit"),
        ("Reflex", ("joint_motion_generator_position_limits_violation",), "joint_limit"),
        ("Reflex", ("communication_constraints_violation",), "communication_lost"),
        ("Reflex", ("self_collision_avoidance_violation",), "self_collision"),
    ],
)
def test_a_state_shows_one_fault(mode: str, errors: tuple[str, ...], code: str) -> None:
    fault = faults.from_mode(mode, errors)
    assert fault is not None
    assert fault.code == code
    assert "recover_robot" in fault.hint
    assert fault.stands == (mode in ("UserStopped", "Guiding", "Other", "AutomaticErrorRecovery"))
    assert code in str(fault.error())


@pytest.mark.parametrize("mode", ["Idle", "Move"])
def test_a_healthy_state_shows_none(mode: str) -> None:
    assert faults.from_mode(mode, ()) is None


def named(kind: str, text: str) -> Exception:
    return type(kind, (Exception,), {})(text)


def test_exceptions_of_the_client_become_faults() -> None:
    reflex = named(
        "ControlException",
        "libfranka: Move command aborted: motion aborted by reflex! "
        '["joint_reflex"]\ncontrol_command_success_rate: 1',
    )
    assert faults.from_exception(reflex).code == "reflex"
    assert "joint_reflex" in faults.from_exception(reflex).message
    assert (
        faults.from_exception(named("NetworkException", "UDP receive: timeout")).code
        == "communication_lost"
    )


@pytest.mark.parametrize(
    ("kind", "text", "code"),
    [
        (
            "CommandException",
            "Move command rejected due to activated safety function!",
            "safety_function",
        ),
        (
            "CommandException",
            "command rejected: command not possible in the current mode (Other)!",
            "not_possible_now",
        ),
        (
            "CommandException",
            "command rejected: manual error recovery required!",
            "manual_recovery",
        ),
        ("CommunicationLost", "no state of the robot came for 25 ms", "communication_lost"),
        ("PlannerException", "planner failed", "planner_failed"),
    ],
)
def test_a_refused_request_is_told_in_words_that_fit(kind: str, text: str, code: str) -> None:
    fault = faults.from_exception(ClientError(kind, f"libfranka: {text}"))
    assert fault.code == code
    assert "recover_robot" in fault.hint


def test_the_mode_other_names_all_that_it_can_mean() -> None:
    fault = faults.from_mode("Other", ())
    assert fault is not None
    for word in ("brakes", "FCI", "self-test"):
        assert word in fault.message
    assert "opens no brakes" in fault.hint


def test_a_refused_recovery_says_why_and_leaves_the_fault_alone() -> None:
    fault = faults.from_exception(named("NetworkException", "libfranka: UDP receive: Timeout"))
    told = [str(faults.still(fault, ClientError("NetworkException", "no route"))) for _ in range(3)]
    assert len(set(told)) == 1
    assert "communication_lost" in told[0]
    assert "no route" in told[0]
    unlock = faults.still(
        fault, ClientError("CommandException", "command not possible in the current mode")
    )
    assert "joints unlocked" in str(unlock)


@pytest.mark.parametrize(
    ("kind", "error", "says"),
    [
        ("RealtimeException", ConfigurationError, "PREEMPT_RT"),
        ("IncompatibleVersionException", ConfigurationError, "Protocol 10"),
        ("NetworkException", NotReadyError, "activate FCI"),
    ],
)
def test_what_prevents_a_connection_is_told(kind: str, error: type[Exception], says: str) -> None:
    told = faults.while_connecting(named(kind, "no"), "10.0.0.1")
    assert isinstance(told, error)
    assert says in str(told)


def test_without_an_address_it_says_what_to_set() -> None:
    with pytest.raises(ConfigurationError, match="Set host"):
        FciDriver(None, profile(), MemoryTopics())


def test_nobody_at_the_address_is_said_at_once() -> None:
    driver = FciDriver(
        FciDriverOptions(host="127.99.0.1", realtime="ignored", gripper=False),
        profile(),
        MemoryTopics(),
    )
    with pytest.raises(NotReadyError, match=r"Nobody answers at 127\.99\.0\.1"):
        driver.open()
    driver.close()


def test_motions_leave_a_stop_the_acceleration_to_replace_them() -> None:
    assert FciDriverOptions(host="10.0.0.1", dynamics_factor=0.5).dynamics_factor == 0.5
    with pytest.raises(ValidationError, match="less than or equal to"):
        FciDriverOptions(host="10.0.0.1", dynamics_factor=0.6)
