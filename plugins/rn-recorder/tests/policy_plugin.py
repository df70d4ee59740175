"""The arm and the policy of `policy_world` as an installed plugin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from policy_world import SPACES, KnowingPolicy, arm_profile
from pydantic import BaseModel, ConfigDict
from wiring_faults import FAULTS

from roboneuron import (
    BackendSpec,
    CameraSpec,
    ControllerSpec,
    ControlSpace,
    DriverSpec,
    RobotProfile,
    RobotSpec,
    hookimpl,
)


class KnowingOptions(BaseModel):
    """Options of the policy."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: str = "ee_delta"
    fault: str = ""
    checkpoint: str | None = None


class Knowing(KnowingPolicy):
    """Built by its options."""

    def __init__(
        self, config: KnowingOptions, runtime: None = None, acceleration: None = None
    ) -> None:
        fault = FAULTS[config.fault].fault if config.fault else None
        super().__init__(config.kind, fault)


def space_of(options: Mapping[str, object], profile: RobotProfile) -> ControlSpace:
    """The space that the options name."""
    return SPACES[str(options.get("kind", "ee_delta"))]


@hookimpl
def roboneuron_robots() -> Sequence[RobotSpec]:
    """The arm."""
    return [
        RobotSpec(
            name="toy",
            summary="Seven hinges.",
            target=f"{__name__}:toy_profile",
            drivers=(
                DriverSpec(
                    name="simulated",
                    summary="None.",
                    target="rn_testing.fakes.robot:FakeDriver",
                    simulated=True,
                ),
            ),
            cameras=(CameraSpec(name="front", role="primary"),),
        )
    ]


def toy_profile() -> RobotProfile:
    """As `arm_profile`."""
    return arm_profile()


@hookimpl
def roboneuron_backends() -> Sequence[BackendSpec]:
    """The policy."""
    return [
        BackendSpec(
            name="knowing",
            summary="Knows the course.",
            target=f"{__name__}:Knowing",
            config=f"{__name__}:KnowingOptions",
            cameras=("primary",),
            needs_state=True,
            space=f"{__name__}:space_of",
        )
    ]


@hookimpl
def roboneuron_controllers() -> Sequence[ControllerSpec]:
    """A controller that is never made."""
    return [
        ControllerSpec(
            name="toy",
            summary="Executes every space.",
            target="rn_testing.fakes.controller:none",
            spaces=("ee_delta", "joint_position", "joint_velocity"),
        )
    ]
