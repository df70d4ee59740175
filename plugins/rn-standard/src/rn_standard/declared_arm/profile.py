"""The robot that a configuration declares in `[robot.arm]`."""

from __future__ import annotations

from collections.abc import Hashable
from functools import lru_cache
from pathlib import Path
from typing import Protocol

from rn_standard.declared_arm.arm_draft import ArmDraft, draft_arm
from rn_standard.declared_arm.real_drivers import REAL_DRIVERS, SIMULATED
from rn_standard.declared_arm.urdf_guesses import Chosen
from roboneuron import CameraSpec, RobotProfile, RobotSpec


class ArmSection(Hashable, Protocol):
    """`[robot.arm]`; see the configuration."""

    @property
    def urdf(self) -> str: ...

    @property
    def base(self) -> str | None: ...

    @property
    def tcp(self) -> str | None: ...

    @property
    def joints(self) -> tuple[str, ...]: ...

    @property
    def gripper(self) -> str | None: ...

    @property
    def home(self) -> tuple[float, ...]: ...

    @property
    def package_paths(self) -> tuple[str, ...]: ...

    @property
    def cameras(self) -> tuple[str, ...]: ...


class RobotSection(Protocol):
    """`[robot]` with an arm that it declares."""

    @property
    def name(self) -> str: ...

    @property
    def driver(self) -> str: ...

    @property
    def arm(self) -> ArmSection | None: ...


def describe(robot: RobotSection) -> RobotSpec:
    """Descriptor of the declared robot; its files are not read."""
    assert robot.arm is not None, "the caller has looked"
    return RobotSpec(
        name=robot.name,
        summary=f"The arm of {Path(robot.arm.urdf).name}, declared in the configuration",
        target="rn_standard.declared_arm.profile:build_profile",
        drivers=(SIMULATED, *(driver.spec for driver in REAL_DRIVERS.values())),
        cameras=tuple(CameraSpec(name=name, role=role) for name, role in _cameras(robot.arm)),
    )


def draft_of(robot: RobotSection) -> ArmDraft:
    """What the URDF says; read once by each process, so that all of one process agree.

    Raises:
        ConfigurationError: as `draft_arm`.
    """
    assert robot.arm is not None, "the caller has looked"
    return _drafted(robot.name, robot.driver, robot.arm)


@lru_cache(maxsize=8)
def _drafted(name: str, driver: str, arm: ArmSection) -> ArmDraft:
    return draft_arm(
        name,
        Path(arm.urdf),
        chosen=Chosen(base=arm.base, tcp=arm.tcp, joints=arm.joints, gripper=arm.gripper),
        package_paths=[Path(path) for path in arm.package_paths],
        driver=driver,
        home=arm.home,
    )


def build_profile(robot: RobotSection) -> RobotProfile:
    """Target of the descriptor; raises as `draft_of`."""
    assert robot.arm is not None, "the caller has looked"
    return draft_of(robot).profile(_cameras(robot.arm))


def _cameras(arm: ArmSection) -> list[tuple[str, str]]:
    """Name and role of each camera."""
    return [(name, name if number else "primary") for number, name in enumerate(arm.cameras)]
