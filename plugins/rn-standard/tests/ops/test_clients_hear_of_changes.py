"""Clients are told when tools and resources change, and only while the feature is there that tells
them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import anyio
import pytest
from mcp import Client

from rn_standard.ops.plugin import CLIENTS
from roboneuron import FeatureSpec
from roboneuron.server.app import Application

STATUS = "roboneuron://status"


@pytest.mark.parametrize("specs", [(CLIENTS,), ()], ids=["with", "without"])
def test_what_clients_are_told_is_announced(
    application_of: Callable[..., Application], specs: tuple[FeatureSpec, ...]
) -> None:
    capabilities = application_of(*specs).server.create_initialization_options().capabilities
    assert capabilities.tools.list_changed is bool(specs)
    assert capabilities.resources.subscribe is bool(specs)


# older revisions of the protocol
@pytest.mark.filterwarnings("ignore::mcp.shared.exceptions.MCPDeprecationWarning")
def test_a_subscribed_client_hears_of_its_resource_and_of_tools(
    application_of: Callable[..., Application],
) -> None:
    application = application_of(CLIENTS)
    heard: list[str] = []

    async def on_message(message: Any) -> None:
        heard.append(str(getattr(message, "method", message)))

    async def scenario() -> None:
        async with Client(application.server, mode="legacy", message_handler=on_message) as client:
            await client.list_tools()
            await client.session.subscribe_resource(STATUS)
            application.host.events.resource.tell(STATUS)
            application.host.events.tools.tell()
            with anyio.fail_after(10):
                while len(heard) < 2:
                    await anyio.sleep(0.01)
            await client.session.unsubscribe_resource(STATUS)

    anyio.run(scenario)
    assert {word.rpartition("/")[2] for word in heard} == {"updated", "list_changed"}
