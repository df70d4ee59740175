"""`roboneuron serve --NAME`: a feature may have a flag that sets one option of its section."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

import pytest
from pydantic import Field

from rn_testing.fakes import fake_registry
from roboneuron import FeatureSpec, Section
from roboneuron.cli.main import run_command
from roboneuron.cli.serve import add_installed_flags, configure
from roboneuron.config import Config, feature_options, parse_config
from roboneuron.errors import ConfigurationError
from roboneuron.plugins.registry import Registry


class Options(Section):
    """`[siren]`."""

    loud: bool = Field(default=False, description="it can be heard")
    tone: int = Field(default=440, description="pitch")


CONFIG = f"{__name__}:Options"
SIREN = FeatureSpec(
    name="siren", summary="Makes a noise.", target=CONFIG, config=CONFIG, switch="loud"
)
SILENT = FeatureSpec(name="silent", summary="Makes none.", target=CONFIG, config=CONFIG)
HOST = FeatureSpec(
    name="host", summary="Called as an option.", target=CONFIG, config=CONFIG, switch="loud"
)


@pytest.fixture
def registry(monkeypatch: pytest.MonkeyPatch) -> Registry:
    """Only these three features are installed."""
    registry = fake_registry(SIREN, SILENT, HOST)
    monkeypatch.setattr("roboneuron.cli.serve.discover", lambda disabled=(): registry)
    return registry


def options(registry: Registry, *words: str, text: str = "") -> Options:
    parser = ArgumentParser()
    configure(parser)
    add_installed_flags(parser)
    config: Config = parse_config(
        f'[robot]\nname = "gantry"\n{text}',
        registry=registry,
        arguments=parser.parse_args(words),
    )
    found = feature_options(SIREN, config)
    assert isinstance(found, Options)
    return found


def test_a_flag_sets_the_option_and_keeps_the_section(registry: Registry) -> None:
    assert not options(registry).loud
    assert options(registry, "--siren") == Options(loud=True)
    assert options(registry, "--siren", text="[siren]\ntone = 220\n") == Options(
        loud=True, tone=220
    )


def test_only_a_feature_that_says_so_has_a_flag(
    registry: Registry, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        options(registry, "--silent")
    assert "--silent" in capsys.readouterr().err


def test_the_flag_of_a_feature_that_is_not_installed_says_what_to_install(
    registry: Registry,
) -> None:
    with pytest.raises(
        ConfigurationError, match=r"rn-view brings it.*pip install -r requirements\.txt"
    ):
        options(registry, "--view")


def test_a_feature_called_as_an_option_leaves_that_alone(registry: Registry) -> None:
    parser = ArgumentParser()
    configure(parser)
    add_installed_flags(parser)
    assert parser.parse_args(["--host", "::1"]).host == "::1"


def test_plugins_are_looked_at_only_for_a_flag_that_core_does_not_have(registry: Registry) -> None:
    added: list[ArgumentParser] = []

    class Serve:
        configure = staticmethod(configure)

        def add_installed_flags(self, parser: ArgumentParser) -> None:
            added.append(parser)
            add_installed_flags(parser)

        def run(self, arguments: Namespace) -> int:
            return len(arguments.switches or ()) if "switches" in arguments else 0

    assert run_command(Serve(), "serve", ["--host", "::1", "-v"]) == 0
    assert not added
    assert run_command(Serve(), "serve", ["--siren"]) == 1
    assert len(added) == 1
