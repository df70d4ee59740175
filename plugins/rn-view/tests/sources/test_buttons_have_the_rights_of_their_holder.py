"""A button is a tool call like any client's: roles are checked by the server, not by what a page
shows.
"""

from __future__ import annotations

import asyncio

import anyio
import pytest

from rn_standard.http.plugin import FEATURE as HTTP
from rn_view.plugin import FEATURE
from rn_view.sources.server_operator import ServerOperator
from rn_view.sources.server_source import ServerSource
from rn_view_attached.source import AttachedSource, ViewNode
from roboneuron.gate.audit import AuditRecord
from roboneuron.server.tool import Holder

VIEWER, OPERATOR = Holder(who="eve", role="viewer"), Holder(who="ann", role="operator")


@pytest.fixture
def application(application_of):
    """A server of the fakes; nothing is started and no ROS is touched."""
    return application_of(FEATURE, HTTP)


def press(application, holder, tool):
    """The text that a page shows after its button was pressed."""
    operator = ServerOperator(application.host)

    async def call():
        operator.loop = asyncio.get_running_loop()
        return await asyncio.wrap_future(operator.call(holder, tool, {}))

    return anyio.run(call)


def test_a_viewer_may_not_act_and_an_operator_may(application):
    assert "needs the role 'operator'" in press(application, VIEWER, "stop_all")
    assert press(application, OPERATOR, "stop_all") == ""


def test_no_button_releases_the_emergency_stop(application):
    application.loop.emergency_stop.file.press(who="somebody", reason="")
    assert "Only a person releases" in press(
        application, Holder(who="root", role="admin"), "reset_emergency_stop"
    )
    assert application.loop.emergency_stop.is_latched()


def test_a_server_that_serves_nobody_yet_says_so(application):
    assert ServerOperator(application.host).call(OPERATOR, "stop_all", {}).result(1)


def test_the_state_and_what_the_gate_refused_are_shown(application):
    source = ServerSource(application.host)
    assert next((row.kind, row.health) for row in source.snapshot().modules) == ("robot", "stopped")
    application.loop.emergency_stop.file.press(who="ann", reason="too fast")
    assert source.snapshot().is_latched
    assert "ann" in source.snapshot().cause
    application.host.audit.write(
        AuditRecord(who="a", role="admin", tool="t", endpoint="x", verdict="allowed")
    )
    application.host.audit.write(
        AuditRecord(who="a", role="admin", tool="t", endpoint="wheels", verdict="refused")
    )
    source.poll()
    assert ["wheels" in event.text for event in source.shown_events.newest(5)] == [True]


def test_the_stop_of_a_view_beside_a_server_is_the_servers(application):
    config = application.loop.config
    directory = application.supervisor.state_directory
    source = AttachedSource(config, application.loop.registry, directory, ViewNode(directory))
    source.press_stop("a visitor")
    assert application.loop.emergency_stop.is_latched()
    assert "a visitor" in application.loop.emergency_stop.cause()
