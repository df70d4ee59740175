"""`roboneuron plugins show`: every fact of a descriptor, its options, and the traceback of what
failed.
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Iterator
from pathlib import Path

import pytest

from rn_standard.console.chosen_plugins import find
from rn_standard.console.plugins_show import PluginsShow, show
from rn_testing.fakes import fake_registry
from rn_testing.fakes.site import PluginSite, plugin_site
from roboneuron.errors import ConfigurationError

GOOD = """
@hookimpl
def roboneuron_backends():
    return [BackendSpec(name="good", summary="Works.", target="good_module:Good",
                        requires=(Requirement(module="json", install="-"),), optional_cameras=("wrist",))]
"""  # noqa: E501


@pytest.fixture
def site(tmp_path: Path) -> Iterator[PluginSite]:
    with plugin_site(tmp_path / "site") as made:
        yield made


def test_it_prints_the_facts_of_a_descriptor_and_tracebacks(site, capsys):
    site.install("rn-good", GOOD)
    site.install("rn-bad", "1 / 0")
    assert show(site.discover(), "good", None) == 0
    out = capsys.readouterr().out
    assert "target: good_module:Good" in out
    assert "optional_cameras: wrist" in out
    assert "action_space: width=7" in out
    assert show(site.discover(), "rn-bad", None) == 0
    assert "ZeroDivisionError" in capsys.readouterr().out


def test_an_unknown_name_suggests_the_nearest(site):
    site.install("rn-good", GOOD)
    with pytest.raises(ConfigurationError, match="Did you mean 'good'"):
        show(site.discover(), "goood", None)


def test_options_are_shown_with_their_defaults(capsys):
    show(fake_registry(), "instant", "backend")
    assert "options, in [plugins.instant]:" in capsys.readouterr().out


def test_the_disabled_plugins_of_a_configuration_are_not_loaded(tmp_path, capsys):
    config = tmp_path / "roboneuron.toml"
    config.write_text('disabled_plugins = ["rn-fastdds"]\n')
    parser = ArgumentParser()
    PluginsShow().configure(parser)
    assert PluginsShow().run(parser.parse_args(["rn-fastdds", "--config", str(config)])) == 0
    assert "disabled" in capsys.readouterr().out


def test_find_takes_offers_by_name_and_kind():
    registry = fake_registry()
    assert [o.spec.kind for _, offers in find(registry, "gantry", None) for o in offers] == [
        "controller",
        "robot",
    ]
    assert [o.spec.kind for _, offers in find(registry, "gantry", "robot") for o in offers] == [
        "robot"
    ]
    with pytest.raises(ConfigurationError, match="of kind backend"):
        find(registry, "gantry", "backend")
