"""A distribution may contain several plugins: each is discovered, disabled and broken
separately.
"""

from __future__ import annotations

import pytest

from rn_testing.fakes.site import HEADER, PluginSite
from roboneuron.config import parse_config
from roboneuron.errors import ConfigurationError
from roboneuron.plugins.registry import Status
from roboneuron.plugins.specs import BackendSpec, FeatureSpec

BACKEND = """
@hookimpl
def roboneuron_backends():
    return [BackendSpec(name="{name}", summary="Works.", target="m:M")]
"""
MINIMAL = '[robot]\nname = "fr3"\n'


def install(site: PluginSite, distribution: str, **sources: str) -> None:
    """A distribution with the plugins rn-<name>, each with the source of its plugin module."""
    site.install(distribution, "")
    lines = ["[roboneuron]"]
    for name, source in sources.items():
        (site.path / f"{name}_module.py").write_text(HEADER + source)
        lines.append(f"rn-{name} = {name}_module")
    info = site.path / f"{distribution.replace('-', '_')}-1.0.dist-info"
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")


def backend(name: str) -> str:
    return BACKEND.format(name=name)


def test_each_plugin_has_its_own_name_and_names_its_distribution(site):
    install(site, "rn-many", one=backend("first"), two=backend("second"))
    registry = site.discover()
    assert [(p.name, p.distribution, p.version) for p in registry.plugins] == [
        ("rn-one", "rn-many", "1.0"),
        ("rn-two", "rn-many", "1.0"),
    ]
    assert [(o.spec.name, o.plugin, o.distribution) for o in registry.all_offers] == [
        ("first", "rn-one", "rn-many"),
        ("second", "rn-two", "rn-many"),
    ]


@pytest.mark.parametrize("fault", ["1 / 0", "raise SystemExit(3)", "import module_that_is_absent"])
def test_a_broken_plugin_leaves_the_others_of_its_distribution(site, fault):
    install(site, "rn-many", one=fault, two=backend("second"))
    registry = site.discover()
    assert {p.name: p.status for p in registry.plugins} == {
        "rn-one": Status.FAILED,
        "rn-two": Status.READY,
    }
    assert list(registry.specs(BackendSpec)) == ["second"]


@pytest.mark.parametrize("written", ["rn-one", "RN_One"])
def test_one_of_them_is_disabled_by_its_name(site, written):
    install(site, "rn-many", one="raise RuntimeError('imported')", two=backend("second"))
    registry = site.discover(disabled=[written])
    assert {p.name: p.status for p in registry.plugins} == {
        "rn-one": Status.DISABLED,
        "rn-two": Status.READY,
    }


def test_the_name_of_the_distribution_disables_all_of_them(site):
    install(
        site, "rn-many", one="raise RuntimeError('imported')", two="raise RuntimeError('imported')"
    )
    site.install("rn-other", backend("other"))
    registry = site.discover(disabled=["rn-many"])
    assert [p.status for p in registry.plugins] == [Status.DISABLED, Status.READY, Status.DISABLED]
    assert list(registry.specs(BackendSpec)) == ["other"]


def test_a_name_that_is_neither_is_refused_with_the_nearest(site):
    install(site, "rn-many", one=backend("first"))
    with pytest.raises(
        ConfigurationError, match=r"'rn-ones' is not installed\. Did you mean 'rn-one'"
    ):
        site.discover(disabled=["rn-ones"])
    with pytest.raises(
        ConfigurationError, match=r"'rn-man' is not installed\. Did you mean 'rn-many'"
    ):
        site.discover(disabled=["rn-man"])


def test_a_conflict_names_plugin_and_distribution(site):
    install(site, "rn-many", one=backend("same"), two=backend("same"))
    site.install("rn-alone", backend("same"))
    with pytest.raises(
        ConfigurationError,
        match="claimed by rn-alone and by rn-one of rn-many and by rn-two of rn-many; uninstall",
    ):
        site.discover().get(BackendSpec, "same")


def test_what_a_disabled_plugin_may_hold_is_not_said_to_be_absent(site):
    """An install hint for an installed package would be wrong: rn-standard contains the tools,
    which are disabled.
    """
    install(site, "rn-standard", one=backend("first"), two=backend("second"))
    registry = site.discover(disabled=["rn-one"])
    assert registry.not_loaded("rn-standard") == "rn-one (disabled)"
    assert registry.not_loaded("rn-eval") == ""
    with pytest.raises(
        ConfigurationError, match=r"no feature 'http'.*Not loaded: rn-one \(disabled\)"
    ) as caught:
        registry.get(FeatureSpec, "http")
    assert "pip install" not in str(caught.value)
    with pytest.raises(
        ConfigurationError,
        match=r"the section 'http': There is no feature 'http'.*Not loaded: rn-one \(disabled\)",
    ):
        parse_config(MINIMAL + "[http]\n", registry=registry)
