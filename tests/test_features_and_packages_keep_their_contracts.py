"""Every installed feature and command keeps the contract of its kind, and its package that of
plugins. Of other kinds the packages' own tests show it, with inputs of their authors.
"""

from __future__ import annotations

import pytest

from rn_testing import CommandContract, FeatureContract, PackageCase, PackageContract
from rn_testing.automatic import make_case
from rn_testing.cases import Case
from roboneuron import Spec
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import PluginRecord, Status

REGISTRY = discover()
PACKAGES = [plugin for plugin in REGISTRY.plugins if plugin.distribution != "roboneuron-core"]
"""The rules of packages are about what a plugin may use of the core."""


def offered(kind: str) -> list[object]:
    """Usable descriptors of a kind, as parameters."""
    return [
        pytest.param(offer.spec, id=offer.spec.name)
        for offer in REGISTRY.all_offers
        if offer.spec.kind == kind and offer.status is Status.READY
    ]


class TestFeatures(FeatureContract):
    @pytest.fixture(params=offered("feature"))
    def plugin(self, request: pytest.FixtureRequest) -> Case[Spec]:
        return make_case(request.param, {})


class TestCommands(CommandContract):
    @pytest.fixture(params=offered("command"))
    def plugin(self, request: pytest.FixtureRequest) -> Case[Spec]:
        return make_case(request.param, {})


class TestPackages(PackageContract):
    @pytest.fixture(params=PACKAGES, ids=lambda plugin: plugin.name)
    def plugin(self, request: pytest.FixtureRequest) -> PackageCase:
        plugin: PluginRecord = request.param
        return PackageCase(distribution=plugin.distribution, plugin=plugin.name)
