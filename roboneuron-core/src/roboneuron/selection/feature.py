"""The feature: arguments for the start tools."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from roboneuron.errors import RoboNeuronError
from roboneuron.plugins.registry import Registry
from roboneuron.selection.choosing import choose
from roboneuron.selection.options import SelectionSections
from roboneuron.selection.permission import check_listed
from roboneuron.selection.requests import REQUESTS, StartChosenInference, choices_of
from roboneuron.server.feature import Feature
from roboneuron.server.host import Host
from roboneuron.server.loop import StartForm

__all__ = ["why_not_started"]
"""Names that other distributions may use."""


class SelectionFeature(Feature[SelectionSections]):
    """Lets clients choose what start_robot, start_perception, start_control and start_inference
    start.
    """

    def start_forms(self, host: Host) -> Sequence[StartForm]:
        """See `Feature.start_forms`.

        Raises:
            ConfigurationError: `agent_options` contains an unknown option.
        """
        self._host = host
        if listed := self.options.selection.agent_options:
            check_listed(listed, host.registry)
        return chosen_forms(lambda: host.registry)

    @property
    def omitted(self) -> Sequence[str]:
        """Models of other machines that cannot be started, see `Feature.omitted`."""
        served = [name for name, model in self.options.models.items() if model.host is not None]
        problems = {name: why_not_started(name, self._host) for name in served}
        return [f"models.{name}: {problem}" for name, problem in problems.items() if problem]


def why_not_started(model: str, host: Host) -> str:
    """Why a model of the configuration cannot be started; empty if it can."""
    request = StartChosenInference(model=model, options={})
    try:
        choose("inference", host.config, host.registry, request)
    except RoboNeuronError as error:
        return str(error)
    return ""


def chosen_forms(registry: Callable[[], Registry]) -> list[StartForm]:
    """Return the forms of all kinds, whose choices are the usable plugins in `registry`."""

    def installed(offer: str) -> dict[str, str]:
        found = registry()
        return dict.fromkeys(found.specs(found.kinds[offer]), "")

    return [
        StartForm(
            kind=kind,
            arguments=arguments,
            plan=choose,
            choices={
                argument: partial(installed, offer) for argument, offer in choices_of(kind).items()
            },
        )
        for kind, arguments in REQUESTS.items()
    ]
