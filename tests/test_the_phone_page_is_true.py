"""docs/phone.md: its commands and its configuration, as they are typed, let a phone look, lead and
stop.
"""

from __future__ import annotations

import os
import pty
import re
import shlex
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest
from lead_client import LeadPage
from page_client import PageClient, ask_stop

from rn_standard.console.parsers import whole_parser
from rn_standard.http.options import HttpOptions
from rn_standard.http.tokens import TokenTable, read_tokens
from rn_testing.waiting import wait_until
from rn_view.options import ViewOptions
from rn_view.web.access import check_address, host_rules
from roboneuron import ConfigurationError
from roboneuron.config import Config, parse_config

PAGE = (Path(__file__).parents[1] / "docs" / "phone.md").read_text(encoding="utf-8")
SERVED, PROXIED = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
[MAKE_TOKEN] = re.findall(r"^\(umask .*$", PAGE, re.MULTILINE)
COMMANDS = [
    shlex.split(line, comments=True)[1:]
    for line in re.findall(r"^roboneuron .*$", PAGE, re.MULTILINE)
]
ADDRESS = "192.168.1.20"
"""Of the machine, on the page."""


@pytest.fixture
def home(environment: dict[str, str], tmp_path: Path) -> dict[str, str]:
    """Environment of the person who has made the token."""
    environment |= {"HOME": str(tmp_path)}
    subprocess.run(["bash", "-c", MAKE_TOKEN], env=environment, check=True, timeout=60)
    return environment


def options_of(config: Config) -> tuple[ViewOptions, HttpOptions]:
    return ViewOptions.model_validate(config.sections["view"]), HttpOptions.of(config)


def test_its_commands_are_taken_by_the_parsers() -> None:
    assert [whole_parser().parse_args(words).command for words in COMMANDS] == [
        "config",
        "up",
        "estop",
        "estop",
    ]


def test_its_token_opens_the_page_to_an_operator(
    home: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", home["HOME"])
    view, http = options_of(parse_config(SERVED))
    token = Path(home["HOME"], "phone.token").read_text(encoding="utf-8").strip()
    tokens = read_tokens(http.tokens, {})
    check_address(view, tokens)
    holder = tokens.find(token)
    assert holder is not None
    assert (holder.who, holder.role) == ("phone", "operator")
    with pytest.raises(ConfigurationError):
        check_address(view, TokenTable([]))


def test_https_needs_what_the_page_says() -> None:
    [proxy] = re.findall(r"^\$ caddy reverse-proxy --from (\S+) --to (\S+)", PAGE, re.MULTILINE)
    served = SERVED[: SERVED.index("[http]")] + PROXIED + SERVED[SERVED.index("[[http.tokens]]") :]
    view, http = options_of(parse_config(re.sub(r"^host = .*$", "", served, flags=re.MULTILINE)))
    rules = host_rules(view, http)
    assert proxy[1] == f"{view.host}:{view.port}"
    assert rules.allows_host([proxy[0]])
    assert rules.allows_origin(f"https://{proxy[0]}")
    assert not rules.allows_origin(f"http://{ADDRESS}:{view.port}")


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


@pytest.fixture
def served(home: dict[str, str], tmp_path: Path) -> Iterator[str]:
    """`roboneuron up` with the page's configuration, on a port of its own; gives the address."""
    port = free_port()
    text = SERVED.replace("enabled = true", f"enabled = true\nport = {port}")
    text += "[supervisor]\nstart_timeout_s = 300\n"
    (tmp_path / "roboneuron.toml").write_text(text, encoding="utf-8")
    check, up = (["roboneuron", *words] for words in COMMANDS[:2])
    subprocess.run(check, cwd=tmp_path, env=home, check=True, timeout=120, capture_output=True)
    log = tmp_path / "up.log"
    with log.open("w", encoding="utf-8") as output:
        running = subprocess.Popen(up, cwd=tmp_path, env=home, stdout=output, stderr=output)
    try:
        wait_until(lambda: "up; Ctrl-C" in log.read_text(encoding="utf-8"), 400.0, poll_s=0.2)
        yield f"http://127.0.0.1:{port}"
    finally:
        running.terminate()
        running.wait(60)


def status_of(url: str, host: str) -> int:
    try:
        with urlopen(Request(url, headers={"Host": host}), timeout=60) as answer:
            return int(answer.status)
    except HTTPError as error:
        return error.code


def joints(page: PageClient) -> dict[str, float]:
    """Measured joints that the page shows [rad]."""
    found = re.findall(r"(fr3_joint\d)\s+(-?\d+\.\d+)", page.text)
    return {name: float(value) for name, value in found}


def follow(phone: LeadPage) -> None:
    """Lead the arm up until it has moved. On a busy machine samples may be late, and the switch is
    needed again.
    """
    start = joints(phone.page)
    assert start

    def has_moved() -> bool:
        now = joints(phone.page)
        return any(abs(now.get(name, at) - at) > 0.02 for name, at in start.items())

    for _ in range(20):
        phone.press()
        phone.push([0.0, 0.0, 0.1, 0.0, 0.0, 0.0], 1.0)
        phone.push([0.0] * 6, 0.3, held=False)
        if has_moved():
            return
        if not phone.is_led:
            assert phone.lead() == ""
    pytest.fail(f"the arm does not follow: {phone.echoes[-20:]}, {phone.text}")


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.filterwarnings("default:Queued a:UserWarning")
def test_a_phone_looks_leads_and_stops_and_a_person_releases(
    served: str, home: dict[str, str], tmp_path: Path
) -> None:
    port = served.rpartition(":")[2]
    assert status_of(served, f"{ADDRESS}:{port}") == 200
    assert status_of(served, f"192.168.1.99:{port}") == 403
    token = Path(home["HOME"], "phone.token").read_text(encoding="utf-8").strip()
    with LeadPage(served, token) as phone:
        assert "take_over" in phone.lead(operate=False), "up operates the robot"
        assert phone.lead() == ""
        wait_until(lambda: bool(joints(phone.page)), 60.0, poll_s=0.1)
        follow(phone)
        ask_stop(served)
        wait_until(lambda: not phone.is_led, 30.0, poll_s=0.1)
        assert phone.lead() != ""
    status, reset = (["roboneuron", *words] for words in COMMANDS[2:])
    told = subprocess.run(status, env=home, check=False, timeout=60, capture_output=True, text=True)
    assert "pressed in the live view" in told.stdout
    person, terminal = pty.openpty()
    try:
        os.write(person, b"y\n")
        subprocess.run(reset, env=home, stdin=terminal, check=True, timeout=60, capture_output=True)
    finally:
        os.close(person)
        os.close(terminal)
    with LeadPage(served, token) as phone:
        assert phone.lead() == ""
        wait_until(lambda: bool(joints(phone.page)), 60.0, poll_s=0.1)
        follow(phone)
