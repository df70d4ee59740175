"""Pages of other places are refused, and the address is checked as for HTTP."""

from __future__ import annotations

import socket
import threading
from contextlib import ExitStack
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest
import viser
from page_client import PageClient, ask_stop
from view_fakes import admission
from view_page import wait_until
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from rn_standard.http.options import HttpOptions
from rn_standard.http.tokens import TokenTable
from rn_view.options import ViewOptions
from rn_view.page.client_page import Page
from rn_view.page.stop_bar import HEADER, STOP_PATH
from rn_view.plugin import FEATURE
from rn_view.web import view_server
from rn_view.web.access import check_address, check_port, host_rules
from roboneuron import ConfigurationError
from roboneuron.cli.main import main
from roboneuron.config import load_config
from roboneuron.server.app import make_served

pytestmark = [pytest.mark.timeout(120), pytest.mark.filterwarnings("default:Queued a:UserWarning")]
PROTOCOL = f"viser-v{viser.__version__}"


def is_let_in(url, **headers):
    """Whether the connection is served: it gets a first message."""
    origin = headers.pop("origin", None)
    try:
        with opened(url, origin=origin, additional_headers=headers) as page:
            page.recv(timeout=20)
            return True
    except InvalidStatus:
        return False


def is_ended(page):
    """Whether the server closes the connection, possibly after messages."""
    try:
        for _ in range(1000):
            page.recv(timeout=20)
    except ConnectionClosed:
        return True
    return False


def opened(url, **options):
    return connect(url.replace("http", "ws"), subprotocols=[PROTOCOL], **options)


def status_of(url, **headers):
    """HTTP status of a request."""
    try:
        with urlopen(Request(url, headers=headers), timeout=20) as answer:
            return answer.status
    except HTTPError as error:
        return error.code


def test_pages_of_other_places_are_refused(serve):
    url = serve().url
    assert is_let_in(url, origin=url)
    assert is_let_in(url)  # no browser
    assert not is_let_in(url, origin="http://evil.example")
    assert not is_let_in(url, origin="null")


def test_requests_for_other_hosts_are_refused(serve):
    url = serve().url
    assert status_of(url) == 200
    assert status_of(url, Host="evil.example") == 403
    assert status_of(url + "/emergency_stop/state", Host="evil.example") == 403
    assert status_of(url + "/nothing") == 404


def test_the_stop_needs_its_header_and_no_link_presses_it(serve, source):
    url = serve().url
    assert status_of(url + STOP_PATH) == 403
    assert status_of(url + STOP_PATH, **{HEADER: "stop", "Origin": "http://evil.example"}) == 403
    assert not source.stops
    assert ask_stop(url) == "Latched."
    assert source.stops == ["a view without a token (127.0.0.1)"]


def test_the_audit_names_whoever_looks_in_that_browser(serve, source):
    url = serve(("0123456789abcdef", "viewer")).url
    with urlopen(url, timeout=20) as answer:
        cookie = answer.headers["Set-Cookie"].partition(";")[0]
    page = PageClient(url, Cookie=cookie)
    wait_until(lambda: "Token" in page.labels)
    ask_stop(url, Cookie=cookie)
    page.choose("Token", "0123456789abcdef")
    page.choose("Show the robot", True)
    wait_until(lambda: "lift the" in page.text)
    ask_stop(url, Cookie=cookie)
    ask_stop(url, Cookie="roboneuron_view=another-cookie-0123456789")
    page.close()
    assert source.stops == [
        "a view without a token (127.0.0.1)",
        "the viewer",
        "a view without a token (127.0.0.1)",
    ]


def test_silent_sockets_take_no_place_and_end(serve, monkeypatch):
    monkeypatch.setattr(view_server, "_SILENT_S", 1.0)
    url = serve(max_viewers=1).url
    with ExitStack() as stack:
        crowd = [stack.enter_context(opened(url, origin=url)) for _ in range(8)]
        page = PageClient(url)
        wait_until(lambda: "lift the" in page.text)
        for one in crowd:
            assert is_ended(one)
        assert not page.is_closed
        page.close()


def test_the_oldest_of_many_silent_sockets_gives_way(serve, monkeypatch):
    monkeypatch.setattr(view_server, "_MOST_SILENT", 4)
    url = serve().url
    with ExitStack() as stack:
        crowd = [stack.enter_context(opened(url, origin=url)) for _ in range(6)]
        for one in crowd[:2]:
            assert is_ended(one)
        for one in crowd[2:]:
            one.recv(timeout=20)


def test_a_page_that_leaves_while_it_is_built_takes_no_place(serve, monkeypatch):
    begun, may_go_on = threading.Event(), threading.Event()

    class SlowPage(Page):
        def __init__(self, *arguments):
            begun.set()
            assert may_go_on.wait(20.0)
            super().__init__(*arguments)

    monkeypatch.setattr(view_server, "Page", SlowPage)
    viewer = serve(max_viewers=1)
    left = PageClient(viewer.url)
    assert begun.wait(20.0)
    left.close()
    wait_until(lambda: not viewer._server.get_clients())
    may_go_on.set()
    page = PageClient(viewer.url)
    wait_until(lambda: "lift the" in page.text)
    page.close()


def test_a_page_that_is_built_slowly_is_not_silent(serve, monkeypatch):
    class SlowPage(Page):
        def __init__(self, *arguments):
            silent.wait(20.0)
            super().__init__(*arguments)

    silent = threading.Event()
    monkeypatch.setattr(view_server, "Page", SlowPage)
    monkeypatch.setattr(view_server, "_SILENT_S", 0.5)
    url = serve().url
    page = PageClient(url)
    with opened(url, origin=url) as other:
        assert is_ended(other)
    silent.set()
    wait_until(lambda: "lift the" in page.text)
    assert not page.is_closed
    page.close()


def test_a_page_that_cannot_be_built_connects_again(serve, monkeypatch):
    class NoPage(Page):
        def show(self, *arguments):
            raise OSError("no more memory")

    monkeypatch.setattr(view_server, "Page", NoPage)
    url = serve().url
    page = PageClient(url)
    wait_until(lambda: page.is_closed)
    monkeypatch.setattr(view_server, "Page", Page)
    page = PageClient(url)
    wait_until(lambda: "lift the" in page.text)
    page.close()


def test_pages_without_a_token_take_no_place_of_those_with_one(serve, monkeypatch):
    monkeypatch.setattr(view_server, "_MOST_WAITING", 3)
    url = serve(("0123456789abcdef", "viewer"), max_viewers=1).url
    anonymous = [PageClient(url) for _ in range(5)]
    wait_until(lambda: [page.is_closed for page in anonymous].count(True) == 2)
    page = PageClient(url)
    wait_until(lambda: "Token" in page.labels)
    page.choose("Token", "0123456789abcdef")
    page.choose("Show the robot", True)
    wait_until(lambda: "lift the" in page.text)
    for one in [*anonymous, page]:
        one.close()


def test_a_page_too_many_has_the_stop(serve, source):
    url = serve(max_viewers=1).url
    first = PageClient(url)
    wait_until(lambda: "lift the" in first.text)
    second = PageClient(url)
    wait_until(lambda: "max_viewers" in second.text)
    assert "lift the" not in second.text
    assert second.press_stop() == "Latched."
    assert source.stops
    for page in (first, second):
        page.close()


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
            check_port(ViewOptions(port=other.getsockname()[1]), TokenTable([]))


def test_only_a_server_needs_the_port_and_not_the_check_of_its_configuration(tmp_path, capsys):
    file = tmp_path / "roboneuron.toml"
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        robot = '[robot]\nname = "fr3"\n'
        file.write_text(
            f'{robot}[supervisor]\nstate_directory = "{tmp_path}"\n[view]\nenabled = true\nport = '
            f"{port}\n"
        )
        assert main(["config", "check", str(file)]) == 0, capsys.readouterr().err
        served = make_served(load_config(file))
        try:
            served.check()
            with pytest.raises(
                ConfigurationError, match=f"Port {port} of 127.0.0.1 cannot be used"
            ):
                served.listen((0, 1))  # of stdio; nothing is read or written
        finally:
            served.close()


def test_a_token_says_who_looks():
    found = admission(ViewOptions(), ("0123456789abcdef", "viewer"))
    assert found.visitor(1) is None
    assert found.tokens.find("0123456789abcdef").role == "viewer"
    assert admission(ViewOptions()).visitor(3).who == "local HTTP client view 3"


def test_it_is_off_unless_asked_for():
    assert not ViewOptions().enabled
    assert FEATURE.keys == ("view",)
