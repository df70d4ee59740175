"""`config show` prints what can be copied, `config reference` the page of all keys."""

from __future__ import annotations

import tomllib
from pathlib import Path

from rn_standard.console.configuration import feature_text, reference
from roboneuron.config import default_text, feature_options, parse_config
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.specs import FeatureSpec

DOCS = Path(__file__).parents[4] / "docs"


def test_what_is_shown_reads_back_as_the_default_configuration() -> None:
    text = default_text() + feature_text()
    assert tomllib.loads(text) == tomllib.loads(default_text())


def test_without_its_hashes_every_line_is_the_default_of_its_feature() -> None:
    registry = discover()
    specs = [spec for spec in registry.specs(FeatureSpec).values() if spec.config is not None]
    assert specs
    lines = [line.removeprefix("# ") for line in feature_text().splitlines()]
    shown = parse_config(default_text() + "\n".join(lines), registry=registry)
    default = parse_config(default_text(), registry=registry)
    assert set(shown.sections) >= {"http", "ops", "direct"}
    assert shown.model_copy(update={"sections": {}}) == default
    for spec in specs:
        assert feature_options(spec, shown) == feature_options(spec, default)


def test_what_has_no_default_is_explained_and_has_no_value() -> None:
    lines = feature_text().splitlines()
    assert any(line.startswith("## joints: ") for line in lines)
    assert any(line.startswith("## [[expose]]") for line in lines)
    assert not any("= none" in line for line in lines)


def test_configuration_page_is_current() -> None:
    page = (DOCS / "configuration.md").read_text(encoding="utf-8")
    assert page == reference(), (
        "run: roboneuron config reference > docs/configuration.md (with all packages installed)"
    )
