"""The feature `declared-arm`: refuses an arm that cannot be built before the server starts."""

from __future__ import annotations

import logging

from rn_standard.declared_arm.profile import draft_of
from roboneuron import Feature
from roboneuron.feature import Config

log = logging.getLogger(__name__)


class DeclaredArm(Feature[None]):
    """The arm of `[robot.arm]`; without one it does nothing."""

    def check(self, config: Config) -> None:
        """Read the URDF, and log what it gives.

        Raises:
            ConfigurationError: the description is refused.
        """
        if config.robot.arm is not None:
            for line in draft_of(config.robot).report():
                log.info(line)
