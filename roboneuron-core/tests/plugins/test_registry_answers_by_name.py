"""The registry finds descriptors by kind and name, or tells why not."""

from __future__ import annotations

import pytest

from roboneuron.errors import ConfigurationError
from roboneuron.plugins.registry import Status
from roboneuron.plugins.specs import BackendSpec, RobotSpec

SOURCE = """
@hookimpl
def roboneuron_backends():
    return [
        BackendSpec(name="servo", summary="Servo.", target="m:Servo"),
        BackendSpec(name="policy", summary="Policy.", target="m:Policy"),
        BackendSpec(name="gpu", summary="Gpu.", target="m:Gpu",
                    requires=(Requirement(module="absent_x", install="pip install x"),)),
    ]
"""


def test_specs_are_ready_only_and_sorted_by_name(site):
    site.install("rn-a", SOURCE)
    registry = site.discover()
    assert list(registry.specs(BackendSpec)) == ["policy", "servo"]
    assert [(o.spec.name, o.status) for o in registry.offers("backend")] == [
        ("gpu", Status.UNAVAILABLE),
        ("policy", Status.READY),
        ("servo", Status.READY),
    ]


def test_get_returns_the_descriptor(site):
    site.install("rn-a", SOURCE)
    assert site.discover().get(BackendSpec, "servo").summary == "Servo."


def test_get_names_the_nearest_and_the_choices(site):
    site.install("rn-a", SOURCE)
    with pytest.raises(
        ConfigurationError,
        match=r"no backend 'sevro'\. Did you mean 'servo'\? Choose one of: policy, servo",
    ):
        site.discover().get(BackendSpec, "sevro")


def test_get_says_how_to_install_what_is_missing(site):
    site.install("rn-a", SOURCE)
    with pytest.raises(
        ConfigurationError, match=r"'gpu' cannot be used.*unavailable.*run: pip install x"
    ):
        site.discover().get(BackendSpec, "gpu")


def test_get_names_plugins_that_did_not_load(site):
    site.install("rn-a", SOURCE)
    site.install("rn-b", "1 / 0")
    with pytest.raises(ConfigurationError, match=r"Not loaded: rn-b \(failed\)"):
        site.discover().get(BackendSpec, "of-rn-b")


def test_an_unknown_kind_is_refused(site):
    with pytest.raises(
        ConfigurationError, match=r"'backends' is no kind of plugin.*Did you mean 'backend'"
    ):
        site.discover().offers("backends")


def test_get_without_any_plugin_says_so(site):
    with pytest.raises(ConfigurationError, match="No robot plugin is ready"):
        site.discover().get(RobotSpec, "fr3")


def test_options_under_the_name_of_a_driver_are_told_where_they_belong(site):
    site.install(
        "rn-arm",
        """
@hookimpl
def roboneuron_robots():
    return [RobotSpec(name="arm", summary="Arm.", target="m:profile", robot_kind="arm",
                      drivers=(DriverSpec(name="bus", summary="Bus.", target="m:Bus"),))]
""",
    )
    with pytest.raises(ConfigurationError, match=r"\[plugins\.arm\]"):
        site.discover().check_name("[plugins.bus]", "bus")
