"""The feature: arguments for the start tools."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from rn_standard.selection.choosing import choose
from rn_standard.selection.options import SelectionSections
from rn_standard.selection.permission import check_listed
from rn_standard.selection.requests import REQUESTS, choices_of
from roboneuron import Feature, Host
from roboneuron.feature import Registry, StartForm


class SelectionFeature(Feature[SelectionSections]):
    """Lets clients choose what start_robot, start_perception, start_control and start_inference
    start.
    """

    def start_forms(self, host: Host) -> Sequence[StartForm]:
        """See `Feature.start_forms`.

        Raises:
            ConfigurationError: `agent_options` contains an unknown option.
        """
        if listed := self.options.selection.agent_options:
            check_listed(listed, host.registry)
        return chosen_forms(lambda: host.registry)


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
