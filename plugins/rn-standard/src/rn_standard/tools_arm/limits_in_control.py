"""Tightened limits and reports of their effect in the control process; called in every module
process.
"""

from __future__ import annotations

from rn_standard.tools_arm.limit_reports import LimitReports
from roboneuron import (
    ConfigurationError,
    ForeignDataError,
    foreign,
)
from roboneuron.feature import models
from roboneuron.node import HoldingModule, Module, ModuleHost, settings


def join(host: ModuleHost) -> None:
    """See `FeatureSpec.on_join`."""
    if host.settings.kind == "control":
        host.on_configured.append(_extend)


def _extend(module: Module) -> None:
    if not isinstance(module, HoldingModule):
        return
    reports = LimitReports(module)
    module.on_limited.append(reports.report)
    resources = module.node.resources
    resources.callback(reports.close)
    limits = LimitsInForce(module)
    name = settings.LIMITS_PARAMETER
    resources.callback(module.node.add_parameter(name, "", limits.use, limits.refusal))


class LimitsInForce:
    """ROS parameter with the limits of one control: JSON of `[limits]`, or empty for the configured
    ones. Used on the executor's thread.
    """

    def __init__(self, control: HoldingModule) -> None:
        self._control = control
        self._report(is_tightened=control.node.settings.tightened is not None)

    def use(self, text: str) -> None:
        """Apply these limits from the next command on. Raises ConfigurationError."""
        self._control.use_limits(self._parse(text))
        self._report(is_tightened=bool(text))

    def refusal(self, text: str) -> str:
        """Reason why these limits cannot be used; empty if they can."""
        try:
            self._control.check_limits(self._parse(text))
        except ConfigurationError as error:
            return error.message
        return ""

    def _report(self, *, is_tightened: bool) -> None:
        self._control.status.set_value("limits", "tightened" if is_tightened else "configured")

    def _parse(self, text: str) -> models.LimitsConfig:
        """Parse limits from a text.

        Raises:
            ConfigurationError: the text is invalid.
        """
        if not text:
            return self._control.config.limits
        try:
            return foreign.decode_model(models.LimitsConfig, text, "the text")
        except ForeignDataError as error:
            raise ConfigurationError(f"The limits are no valid [limits]: {error}") from error
