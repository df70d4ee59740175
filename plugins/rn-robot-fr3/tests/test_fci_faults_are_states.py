"""Every fault of the arm has one code and says what to do; the driver refuses motion until a person recovered it."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from rn_robot_fr3.fci import faults
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
    assert fault.stands == (mode in ("UserStopped", "Guiding", "Other"))
    assert code in str(fault.error())


@pytest.mark.parametrize("mode", ["Idle", "Move"])
def test_a_healthy_state_shows_none(mode: str) -> None:
    assert faults.from_mode(mode, ()) is None


def named(kind: str, text: str) -> Exception:
    return type(kind, (Exception,), {})(text)


def test_exceptions_of_the_client_become_faults() -> None:
    reflex = named(
        "ControlException",
        'libfranka: Move command aborted: motion aborted by reflex! ["joint_reflex"]\ncontrol_command_success_rate: 1',
    )
    assert faults.from_exception(reflex).code == "reflex"
    assert "joint_reflex" in faults.from_exception(reflex).message
    assert faults.from_exception(named("NetworkException", "UDP receive: timeout")).code == "communication_lost"


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
    pytest.importorskip("franky", reason="needs franky-control: pip install 'rn-robot-fr3[fci]'")
    driver = FciDriver(FciDriverOptions(host="127.99.0.1", realtime="ignored"), profile(), MemoryTopics())
    with pytest.raises(NotReadyError, match=r"Nobody answers at 127\.99\.0\.1"):
        driver.open()
    driver.close()


def test_motions_leave_a_stop_the_acceleration_to_replace_them() -> None:
    assert FciDriverOptions(host="10.0.0.1", dynamics_factor=0.5).dynamics_factor == 0.5
    with pytest.raises(ValidationError, match="less than or equal to"):
        FciDriverOptions(host="10.0.0.1", dynamics_factor=0.6)
