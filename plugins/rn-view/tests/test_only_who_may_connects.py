"""Pages of other places are refused, and the address is checked as for HTTP."""

from __future__ import annotations

import socket

import pytest
import viser
from view_fakes import admission
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from rn_serve_http.options import HttpOptions
from rn_serve_http.tokens import TokenTable
from rn_view.access import check_address, host_rules
from rn_view.options import ViewOptions
from rn_view.plugin import FEATURE
from roboneuron import ConfigurationError

PROTOCOL = f"viser-v{viser.__version__}"
POLICY_VIOLATION = 1008


def is_let_in(url, **headers):
    """Whether a connection is served: it gets the first message."""
    origin = headers.pop("origin", None)
    with connect(url.replace("http", "ws"), origin=origin, subprotocols=[PROTOCOL], additional_headers=headers) as page:
        try:
            page.recv(timeout=20)
        except ConnectionClosed as closed:
            return closed.rcvd.code != POLICY_VIOLATION
        return True


def test_pages_of_other_places_are_refused(serve):
    url = serve().url
    assert is_let_in(url, origin=url)
    assert is_let_in(url)  # no browser
    assert not is_let_in(url, origin="http://evil.example")
    assert not is_let_in(url, origin="null")


def test_there_is_a_most_of_pages(serve):
    url = serve(max_viewers=1).url
    with connect(url.replace("http", "ws"), origin=url, subprotocols=[PROTOCOL]) as first:
        first.recv(timeout=20)
        assert not is_let_in(url, origin=url)


def test_no_page_gets_a_public_address(serve):
    viewer = serve()
    assert viewer._server.request_share_url() is None


def test_every_address_but_loopback_needs_tokens():
    with pytest.raises(ConfigurationError, match="there is no token"):
        check_address(ViewOptions(host="0.0.0.0", port=0), TokenTable([]))


def test_every_address_needs_names_of_this_machine():
    with pytest.raises(ConfigurationError, match="allowed_hosts"):
        host_rules(ViewOptions(host="0.0.0.0"), HttpOptions())
    rules = host_rules(ViewOptions(host="0.0.0.0"), HttpOptions(allowed_hosts=("robot.lan",)))
    assert rules.allows_origin("http://robot.lan:8780")
    assert not rules.allows_origin("http://other.lan:8780")


def test_a_port_in_use_is_said_before_the_robot_starts():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        with pytest.raises(ConfigurationError, match="cannot be used"):
            check_address(ViewOptions(port=other.getsockname()[1]), TokenTable([]))


def test_a_token_says_who_looks():
    found = admission(ViewOptions(), ("0123456789abcdef", "viewer"))
    assert found.visitor(1) is None
    assert found.tokens.find("0123456789abcdef").role == "viewer"
    assert admission(ViewOptions()).visitor(3).who == "local HTTP client view 3"


def test_it_is_off_unless_asked_for():
    assert not ViewOptions().enabled
    assert FEATURE.keys == ("view",)
