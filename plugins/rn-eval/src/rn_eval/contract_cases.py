"""Case class for suites, and the cases of the suites "cubes" and "hand-over"; loaded only by the
contract kit and by tests.

Third parties test their own suite with `contract_of(SuiteSpec)` and a `SuiteCase`, as this
package's tests do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar, cast

import numpy as np

from rn_eval.hooks import SuiteSpec
from rn_eval.plan import with_body
from rn_eval.plugin import CUBES, HAND_OVER
from rn_eval.suite import F64, Setup, Suite
from rn_robot_fr3.cell import FACING_M
from rn_testing.case import Case
from roboneuron import EE_DELTA, Controller, ControllerSpec, robot_space
from roboneuron.command import discover, load_config
from roboneuron.feature import build, load_profile

TICKS = 20
"""Number of ticks for which a rule advances a scene."""
MOVE = np.array([0.02, 0.0, -0.01, 0.0, 0.0, 0.0, 1.0])
"""An action that every arm can follow, to test whether actions have an effect."""


@dataclass(frozen=True, kw_only=True)
class SuiteCase(Case[SuiteSpec]):
    """A suite under test.

    Attributes:
        setup: builds the setup of the scenes; None for the installed robot with its controller, or
            the suite's body.
        idle_ticks: duration in which doing nothing must not succeed.
        move: a row of the setup's space, to test whether actions have an effect.
    """

    subject: ClassVar[str] = "suite"

    setup: Callable[[], Setup] | None = None
    idle_ticks: int = TICKS
    move: F64 = field(default_factory=MOVE.copy)

    def build(self) -> Suite:
        """A new suite."""
        return cast("Suite", self.prepare()())

    def make_setup(self) -> Setup:
        """Setup for opening scenes."""
        if self.setup is not None:
            return self.setup()
        registry, config = with_body(discover(), self.spec), load_config(None)
        profile = load_profile(
            registry, self.spec.robot if self.spec.body is None else self.spec.body.name
        )
        controller: Controller | None = None
        if self.spec.body is None:
            assert config.control is not None
            name = config.control.controller
            controller = cast(
                "Controller",
                build(registry.get(ControllerSpec, name), config.options(name), profile),
            )
            controller.load()
        cameras = {camera.role: camera for camera in profile.cameras}
        return Setup(
            profile=profile,
            cameras=cameras,
            controller=controller,
            config=config,
            needs_state=True,
            space=robot_space("ee_pose", profile) if profile.arms else EE_DELTA,
        )


def cubes_case() -> SuiteCase:
    """Case of the suite "cubes", with small images."""
    return SuiteCase(spec=CUBES, options={"image_px": 64})


def hand_over_case() -> SuiteCase:
    """Case of the suite "hand-over", with small images; the left hand moves from its home."""
    left = [0.327, 0.0, 0.477, 1.0, 0.0, 0.0, 0.0, 1.0]
    right = [FACING_M - 0.307, 0.0, 0.487, 0.0, 1.0, 0.0, 0.0, 1.0]
    return SuiteCase(spec=HAND_OVER, options={"image_px": 64}, move=np.array([*left, *right]))
