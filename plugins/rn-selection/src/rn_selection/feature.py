"""The feature: the start tools take arguments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from rn_selection.choosing import choose
from rn_selection.options import SelectionSections
from rn_selection.requests import REQUESTS, choices_of
from roboneuron.errors import InternalError
from roboneuron.server.feature import Feature
from roboneuron.server.host import Host
from roboneuron.server.tool import Tool


class SelectionFeature(Feature[SelectionSections]):
    """Lets clients say what start_robot, start_perception, start_control and start_inference start."""

    def tools(self, host: Host) -> Sequence[Tool[Any]]:
        """None of its own: those of core get arguments. See `Feature.tools`."""
        host.loop.choose = choose
        for kind, arguments in REQUESTS.items():
            tool = host.tools.get(f"start_{kind}")
            if tool is None:
                raise InternalError(f"There is no tool start_{kind}.")
            choices = {argument: _installed(host, offer) for argument, offer in choices_of(kind).items()}
            host.tools.replace(replace(tool, arguments=arguments, choices=choices))
        return ()


def _installed(host: Host, kind: str) -> Callable[[], dict[str, str]]:
    """Asks for the usable plugins of a kind: name -> summary."""
    return lambda: {name: spec.summary.rstrip(".") for name, spec in host.registry.specs(kind).items()}
