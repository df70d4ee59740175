"""take_over, heartbeat and the lease are there over stdio too, and the feature leaves nothing
open.
"""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Any

import anyio
import pytest
from mcp import Client

from rn_standard.http.feature import HttpFeature
from rn_standard.http.plugin import FEATURE
from rn_testing.waiting import wait_until
from roboneuron.errors import ConfigurationError
from roboneuron.server.app import Application
from roboneuron.server.host import Host
from roboneuron.supervisor.health import ModuleView

Make = Callable[[str], Application]


@pytest.fixture
def make(application_of: Callable[..., Application]) -> Make:
    """Return a function that builds an application with sections of roboneuron.toml."""
    return lambda text: application_of(FEATURE, text=f'[robot]\nname = "gantry"\n{text}')


def test_a_client_on_stdio_takes_over_and_renews_its_lease(make: Make) -> None:
    application = make("[http]\nlease_s = 5.0\n")

    async def scenario() -> list[Any]:
        async with Client(application.server) as client:
            names = {tool.name for tool in (await client.list_tools()).tools}
            assert "take_over" in names
            return [
                (await client.call_tool(name, {})).structured_content
                for name in ("take_over", "heartbeat")
            ]

    assert [answer["operator"] for answer in anyio.run(scenario)] == ["agent on stdio"] * 2


@pytest.mark.parametrize("is_moving", [True, False])
def test_motion_ends_and_people_are_told_when_the_lease_lapses(
    make: Make, monkeypatch: pytest.MonkeyPatch, is_moving: bool
) -> None:
    application = make("[http]\nlease_s = 0.05\n")
    ended: list[str] = []
    faults: list[tuple[str, str]] = []
    monkeypatch.setattr(
        application, "end_direct_motion", lambda reason, timeout_s: ended.append(reason) is None
    )
    monkeypatch.setattr(Host, "is_moving", is_moving)
    application.events.fault.listen(lambda module, what, facts: faults.append((module, what)))
    application.features.start(application.host)
    lease = application.host.feature("http", HttpFeature).lease
    assert lease is not None
    lease.take_over("ann", "operator")
    wait_until(lambda: bool(ended), 30.0)
    lease.close()  # returns when the lapse is dealt with
    assert faults == ([("inference", "lease")] if is_moving else [])
    assert "The lease of 'ann' has lapsed" in ended[0]


@pytest.mark.parametrize(
    ("transport", "lease_s", "expected_s"),
    [
        ("http", "", 120.0),
        ("http", "lease_s = 20.0", 20.0),
        ("http", 'lease_s = "never"', None),
        ("stdio", "", None),
        ("stdio", "lease_s = 20.0", 20.0),
    ],
)
def test_leases_are_on_over_http_unless_they_are_configured_away(
    make: Make, transport: str, lease_s: str, expected_s: float | None
) -> None:
    application = make(f'[server]\ntransport = "{transport}"\n[http]\n{lease_s}\n')

    async def scenario() -> Any:
        async with Client(application.server) as client:
            return (await client.call_tool("heartbeat", {})).structured_content

    assert anyio.run(scenario)["lease_s"] == expected_s


def test_a_robot_at_rest_is_not_moving_and_one_with_a_policy_is(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    host = make("").host
    assert not host.is_moving
    monkeypatch.setattr(host.modules, "view", lambda kind: ModuleView(kind=kind, phase="running"))
    assert host.is_moving


def test_modules_do_not_get_the_variables_of_tokens(make: Make) -> None:
    tokens = '[[http.tokens]]\nname = "boss"\nrole = "admin"\nvariable = "THE_BOSS"\n'
    application = make(tokens)
    assert application.supervisor.secret_variables == {"THE_BOSS"}
    assert application.host.identifies_clients
    assert not make("").host.identifies_clients


def test_the_address_is_free_again_after_close(make: Make) -> None:
    application = make('[server]\ntransport = "http"\n[http]\nport = 0\n')
    assert application.features.listen(application.host) is not None
    listener = application.host.feature("http", HttpFeature).listener
    assert listener is not None
    address = listener.getsockname()
    listener.listen()
    other = make(f'[server]\ntransport = "http"\n[http]\nport = {address[1]}\n')
    with pytest.raises(ConfigurationError, match="cannot be used"):
        other.features.listen(other.host)
    application.close()
    with socket.create_server(address):
        pass
