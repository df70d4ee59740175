"""A port is refused where it is written, with its range: on command lines and in sections."""

from __future__ import annotations

from pathlib import Path

import pytest

from roboneuron.cli.main import main

COMMANDS = [
    ("serve", "--transport", "http"),
    ("view",),
    ("policy", "serve"),
    ("policy", "openpi"),
    ("eval", "serve"),
]
SECTIONS = {
    "http.port": "[http]\nport = {port}",
    "view.port": "[view]\nport = {port}",
    "metrics.port": "[metrics]\nport = {port}",
}


PORTS = ["65536", "99999", "-1", "9" * 400]


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_a_command_refuses_a_port_out_of_range(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    for port in PORTS:
        with pytest.raises(SystemExit) as ended:
            main([*words, f"--port={port}"])
        assert ended.value.code == 2
        assert "from 0 to 65535" in capsys.readouterr().err, port


@pytest.mark.parametrize("port", ["65536", "99999", "-1"])
@pytest.mark.parametrize("section", SECTIONS)
def test_a_section_refuses_a_port_out_of_range(
    section: str, port: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "roboneuron.toml"
    path.write_text(f'[robot]\nname = "fr3"\n{SECTIONS[section].format(port=port)}\n')
    assert main(["config", "check", str(path)]) != 0
    told = capsys.readouterr()
    text = told.out + told.err
    assert section in text
    assert port in text
    assert ("0" if port == "-1" else "65535") in text


@pytest.mark.parametrize("port", [65536, 99999])
def test_the_address_of_a_policy_server_has_a_port(port: int) -> None:
    from rn_backend_openpi.options import PolicyOptions

    with pytest.raises(ValueError, match="from 1 to 65535"):
        PolicyOptions(address=f"gpu:{port}")
    assert PolicyOptions(address="gpu:65535").address == "gpu:65535"
