"""`roboneuron config check` refuses the same as `serve` at its start."""

from __future__ import annotations

from pathlib import Path

import pytest

from rn_testing.fakes import fake_registry
from roboneuron.cli.main import main
from roboneuron.config import parse_config
from roboneuron.errors import ConfigurationError
from roboneuron.planning import check_configuration
from roboneuron.plugins.registry import PluginRecord, Registry, Status
from roboneuron.plugins.specs import BackendSpec

REGISTRY = fake_registry(BackendSpec(name="plain", summary="Takes no options.", target="nowhere:X"))
ROBOT = '[robot]\nname = "gantry"\n'

WRONG = [
    (
        "[plugins.instnat]\nhorizon = 3\n",
        "[plugins.instnat]: nothing is called 'instnat'. Did you mean 'instant'?",
    ),
    (
        "[plugins.instant]\nhorizn = 3\n",
        "unknown key 'plugins.instant.horizn'. Did you mean 'horizon'?",
    ),
    ("[plugins.instant]\nhorizon = 99\n", "plugins.instant.horizon = 99"),
    ("[plugins.gantry]\nstart_opne = true\n", "unknown key 'plugins.gantry.start_opne'"),
    ("[plugins.plain]\nx = 1\n", "plugins.plain.x is unknown: 'plain' takes no options."),
    (
        "[plugins.pi0]\n",
        "[plugins.pi0]: 'pi0' is not installed. Run: pip install "
        '"./plugins/rn-backend-pi0[native]"',
    ),
    ('[inference]\nbackend = "instnat"\n', "no backend 'instnat'"),
]


@pytest.mark.parametrize(("text", "words"), WRONG, ids=[w[1][:40] for w in WRONG])
def test_what_is_wrong_is_named(text: str, words: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        check_configuration(parse_config(ROBOT + text), REGISTRY)
    assert words in str(caught.value)


def test_all_that_is_wrong_is_told_at_once_and_once() -> None:
    text = '[robot]\nname = "gantri"\n[perception]\nsource = "controlled"\n'
    text += "[plugins.instnat]\n[plugins.instant]\nhorizon = 99\n"
    with pytest.raises(ConfigurationError) as caught:
        check_configuration(parse_config(text), REGISTRY)
    lines = str(caught.value).splitlines()
    assert len(lines) == 3
    assert "'gantri'" in lines[0]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[plugins.instant]\nhorizon = 3\n",
        "[plugins.plain]\n",
    ],
)
def test_what_is_right_passes(text: str) -> None:
    check_configuration(parse_config(ROBOT + text), REGISTRY)


def test_options_of_plugins_that_are_left_out_are_not_judged() -> None:
    def with_plugin(distribution: str) -> Registry:
        record = PluginRecord(
            name=distribution,
            distribution=distribution,
            version="1",
            module="m",
            status=Status.DISABLED,
        )
        return Registry(plugins=(*REGISTRY.plugins, record), all_offers=REGISTRY.all_offers)

    check_configuration(parse_config(f"{ROBOT}[plugins.pi0]\n"), with_plugin("rn-backend-pi0"))
    check_configuration(parse_config(f"{ROBOT}[plugins.zzz-of-another]\n"), with_plugin("rn-x"))
    with pytest.raises(ConfigurationError, match="nothing is called 'zzz-of-another'"):
        check_configuration(parse_config(f"{ROBOT}[plugins.zzz-of-another]\n"), REGISTRY)


def check(tmp_path: Path, text: str) -> int:
    path = tmp_path / "roboneuron.toml"
    path.write_text(f'{text}\n[supervisor]\nstate_directory = "{tmp_path}/state"\n')
    return main(["config", "check", str(path)])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[robot]\nname = "no-such-robot"\n', "no robot 'no-such-robot'"),
        (
            '[robot]\nname = "fr3"\n[server]\ntransport = "htpt"\n',
            "transport = 'htpt': There is no feature 'htpt'.",
        ),
    ],
)
def test_the_command_fails_with_the_reason(
    text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rn_robot_fr3")
    assert check(tmp_path, text) == 2
    assert words in capsys.readouterr().err


def test_the_command_passes_a_good_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rn_robot_fr3")
    assert check(tmp_path, '[robot]\nname = "fr3"\n') == 0
    assert "is valid" in capsys.readouterr().out
