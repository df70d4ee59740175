"""The feature: arguments for the start tools."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from rn_standard.selection.choosing import choose
from rn_standard.selection.options import SelectionSections
from rn_standard.selection.permission import check_listed
from rn_standard.selection.requests import REQUESTS, choices_of
from roboneuron import Feature, Host, InternalError, Tool


class SelectionFeature(Feature[SelectionSections]):
    """Lets clients choose what start_robot, start_perception, start_control and start_inference
    start.
    """

    def tools(self, host: Host) -> Sequence[Tool]:
        """Return no new tools: those of core get arguments. See `Feature.tools`.

        Raises:
            ConfigurationError: `agent_options` contains an unknown option.
        """
        if listed := self.options.selection.agent_options:
            check_listed(listed, host.registry)
        host.loop.choose = choose
        for kind, arguments in REQUESTS.items():
            tool = host.tools.get(f"start_{kind}")
            if tool is None:
                raise InternalError(f"There is no tool start_{kind}.")
            choices = {
                argument: _installed(host, offer) for argument, offer in choices_of(kind).items()
            }
            host.tools.replace(replace(tool, arguments=arguments, choices=choices))
        return ()


def _installed(host: Host, kind: str) -> Callable[[], dict[str, str]]:
    """Return a function for the names of the usable plugins of a kind, with their summaries."""
    return lambda: dict.fromkeys(host.registry.specs(host.registry.kinds[kind]), "")
