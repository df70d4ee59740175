"""What a server over HTTP refuses before it starts anything; nothing is spawned here."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from rn_standard.http.options import HttpOptions, TokenConfig
from rn_standard.http.origins import HostRules
from rn_standard.http.plugin import FEATURE
from rn_standard.http.server import listen
from rn_standard.http.tokens import TokenFiles, TokenTable, read_tokens
from rn_testing.fakes import fake_registry
from roboneuron.cli.main import main
from roboneuron.cli.serve import configure
from roboneuron.config import Config, feature_options, parse_config
from roboneuron.errors import ConfigurationError
from roboneuron.server.app import serve

GOOD = "a-token-of-sufficient-length"
REGISTRY = fake_registry(FEATURE)


def config(http: str) -> Config:
    text = f'[robot]\nname = "fr3"\n[server]\ntransport = "http"\n[http]\nport = 0\n{http}'
    return parse_config(text, registry=REGISTRY)


def options(http: str) -> HttpOptions:
    made = feature_options(FEATURE, config(http))
    assert isinstance(made, HttpOptions)
    return made


@pytest.mark.parametrize("http", ['host = "0.0.0.0"\nallowed_hosts = ["robot.lan"]', 'host = "::"'])
def test_an_address_for_others_needs_a_token(http: str, tmp_path: Path) -> None:
    pytest.importorskip("rn_robot_fr3")
    with pytest.raises(ConfigurationError, match=r"token|allowed_hosts"):
        serve(config(f'{http}\n[supervisor]\nstate_directory = "{tmp_path}"\n'), (0, 1))
    with pytest.raises(ConfigurationError, match="anybody could move the robot"):
        listen(options('host = "0.0.0.0"'), TokenTable([]))


def test_with_a_token_it_listens_for_others() -> None:
    tokens = read_tokens((TokenConfig(name="lab", role="viewer", variable="T"),), {"T": GOOD})
    with listen(options('host = "0.0.0.0"'), tokens) as listener:
        assert listener.getsockname()[1] > 0


def test_listening_everywhere_needs_the_names_of_this_machine() -> None:
    with pytest.raises(ConfigurationError, match="allowed_hosts"):
        HostRules(options('host = "0.0.0.0"'))
    named = HostRules(options('host = "0.0.0.0"\nallowed_hosts = ["robot.lan"]'))
    assert named.allows_host(["robot.lan"])
    assert named.allows_host(["Robot.LAN:8765"])


RULES = HostRules(
    options(
        'allowed_hosts = ["robot.lan", "proxy.lan:8443", "fd00::1"]\n'
        'allowed_origins = ["https://panel.lan", "http://tool.lan:*"]'
    )
)


@pytest.mark.parametrize(
    "host",
    ["127.0.0.1:8765", "localhost", "[::1]:1", "robot.lan.", "proxy.lan:8443", "[fd00:0::1]"],
)
def test_hosts_of_this_server_are_known_in_every_spelling(host: str) -> None:
    assert RULES.allows_host([host])


@pytest.mark.parametrize(
    "host",
    [
        "",
        "robot.lan:evil",
        "robot.lan:80@evil",
        "robot.lan:99999",
        "robot.lan.evil",
        "robot.lan:*",
        "proxy.lan:8444",
        "proxy.lan",
        "127.0.0.1:8765:1",
        "localhost:80/x",
        "user@localhost",
        "[::1",
        " localhost",
    ],
)
def test_hosts_that_only_begin_like_one_of_ours_are_refused(host: str) -> None:
    assert not RULES.allows_host([host])
    assert not RULES.allows_host([])
    assert not RULES.allows_host(["localhost", "localhost"])


def test_origins_are_parsed() -> None:
    good = [
        "https://panel.lan",
        "https://PANEL.lan:443",
        "http://localhost:3000",
        "http://tool.lan:5",
        "http://[::1]",
    ]
    bad = [
        "null",
        "https://panel.lan.evil",
        "https://panel.lan:444",
        "http://panel.lan",
        "http://localhost:80.evil",
        "http://tool.lan:5@evil",
        "https://localhost",
        "http://tool.lan:*",
        "file://",
        "http://",
    ]
    assert [text for text in good if not RULES.allows_origin(text)] == []
    assert [text for text in bad if RULES.allows_origin(text)] == []


@pytest.mark.parametrize(
    "line", ['allowed_origins = ["panel.lan"]', 'allowed_hosts = ["http://robot.lan"]']
)
def test_what_cannot_be_a_host_or_an_origin_is_refused(line: str) -> None:
    with pytest.raises(ConfigurationError, match="is none"):
        HostRules(options(line))


def test_a_port_in_use_is_named() -> None:
    with listen(options(""), TokenTable([])) as first:
        first.listen()
        section = options("").model_copy(update={"port": first.getsockname()[1]})
        with pytest.raises(
            ConfigurationError, match=f"Port {section.port} of 127.0.0.1 cannot be used"
        ):
            listen(section, TokenTable([]))


@pytest.mark.parametrize(
    "token", ["", "short", "with space in the middle of it", "ümläuts-are-not-in-headers"]
)
def test_bad_tokens_are_refused_and_not_shown(token: str) -> None:
    with pytest.raises(ConfigurationError) as refusal:
        read_tokens((TokenConfig(name="lab", role="viewer", variable="T"),), {"T": token})
    assert "'lab'" in str(refusal.value)
    assert not token or token not in str(refusal.value)


def test_a_token_is_in_one_place_and_of_one_holder() -> None:
    section = TokenConfig(name="lab", role="viewer", variable="T")
    with pytest.raises(ConfigurationError, match="either `variable` or `file`"):
        read_tokens((TokenConfig(name="lab", role="viewer"),), {})
    with pytest.raises(ConfigurationError, match="another entry"):
        read_tokens((section, TokenConfig(name="other", role="admin", variable="T")), {"T": GOOD})
    with pytest.raises(ConfigurationError, match=r"unknown key 'http\.tokens\.0\.token'"):
        config('[[http.tokens]]\nname = "lab"\nrole = "admin"\ntoken = "written down"')


def test_a_file_with_a_token_is_only_for_its_owner(tmp_path: Path) -> None:
    file = tmp_path / "token"
    file.write_text(GOOD + "\n")
    section = TokenConfig(name="lab", role="operator", file=str(file))
    file.chmod(0o644)
    with pytest.raises(ConfigurationError, match="others can read"):
        read_tokens((section,), {})
    file.chmod(0o600)
    table = read_tokens((section,), {})
    holder = table.find(GOOD)
    assert holder is not None
    assert (holder.who, holder.role) == ("lab", "operator")
    assert table.find(GOOD + "x") is None
    assert GOOD not in repr(vars(table))


def test_the_command_line_goes_before_the_file() -> None:
    parser = argparse.ArgumentParser()
    configure(parser)
    base = '[robot]\nname = "none"\n'

    def said(text: str, *words: str) -> Config:
        return parse_config(text, registry=REGISTRY, arguments=parser.parse_args(words))

    chosen = said(base, "--transport", "http", "--port", "9000")
    address = feature_options(FEATURE, chosen)
    assert isinstance(address, HttpOptions)
    assert (chosen.server.transport, address.host, address.port) == ("http", "127.0.0.1", 9000)
    file = f'{base}[server]\ntransport = "http"\n[http]\nhost = "::1"\n'
    there = said(file, "--port", "1").sections["http"]
    assert there == {"host": "::1", "port": 1}
    with pytest.raises(ConfigurationError, match="--transport http"):
        said(base, "--port", "9000")
    with pytest.raises(ConfigurationError, match=r"the command line: http\.port = 70000"):
        said(base, "--transport", "http", "--port", "70000")


def test_a_token_file_that_changes_is_read_again(tmp_path: Path) -> None:
    mine, yours = tmp_path / "mine", tmp_path / "yours"
    for path, token in ((mine, GOOD), (yours, GOOD[::-1])):
        path.write_text(token)
        path.chmod(0o600)
    sections = (
        TokenConfig(name="mine", role="admin", file=str(mine)),
        TokenConfig(name="yours", role="viewer", file=str(yours)),
    )
    tokens = TokenFiles(sections, {})

    def holder(token: str) -> str:
        found = tokens.find(token)
        return found.who if found is not None else ""

    assert (holder(GOOD), holder(GOOD[::-1])) == ("mine", "yours")
    mine.write_text("another-token-of-sufficient-length")
    assert (holder(GOOD), holder("another-token-of-sufficient-length")) == ("", "mine")
    mine.write_text("short")
    assert (holder("short"), holder(GOOD[::-1])) == ("", "yours")
    mine.write_text(GOOD[::-1])
    assert holder(GOOD[::-1]) == "mine", "the first entry keeps a token that two files hold"
    mine.write_text(GOOD)
    mine.chmod(0o644)
    assert (holder(GOOD), holder(GOOD[::-1])) == ("", "yours"), "others can read it"
    mine.unlink()
    yours.unlink()
    assert (holder(GOOD), holder(GOOD[::-1])) == ("", "")
    assert tokens, "a token is asked for all the same"
    mine.write_text(GOOD)
    mine.chmod(0o600)
    assert holder(GOOD) == "mine"


@pytest.mark.parametrize(
    ("http", "words"),
    [
        (
            'tokens = [{ name = "x", role = "admin", variable = "NOT_SET_AT_ALL" }]',
            "NOT_SET_AT_ALL, which is not set",
        ),
        ('host = "0.0.0.0"', "allowed_hosts"),
    ],
)
def test_config_check_says_what_serve_would(
    http: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rn_robot_fr3")
    path = tmp_path / "roboneuron.toml"
    text = (
        '[robot]\nname = "fr3"\n[supervisor]\nstate_directory = '
        f'"{tmp_path}/state"\n[http]\n{http}\n'
    )
    path.write_text(text + '[server]\ntransport = "http"\n')
    assert main(["config", "check", str(path)]) == 2
    assert words in capsys.readouterr().err
    path.write_text(text)
    assert main(["config", "check", str(path)]) == 0, "over stdio nobody asks for them"
