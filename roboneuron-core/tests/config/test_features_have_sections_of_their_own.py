"""Sections of features are typed, checked with suggestions, and refused if nothing owns them."""

from __future__ import annotations

import pytest

from rn_testing.fakes import fake_registry
from roboneuron import FeatureSpec
from roboneuron.config import ModuleSettings, feature_options, parse_config
from roboneuron.errors import ConfigurationError
from roboneuron.plugins.registry import Offer, Registry, Status

ROBOT = '[robot]\nname = "gantry"\n'
RECORDER = FeatureSpec(
    name="run-recorder", summary="Records.", target="m:F", config=f"{__name__}:RecorderSection"
)
PAIR = FeatureSpec(
    name="pair",
    summary="Two sections.",
    target="m:F",
    config=f"{__name__}:PairSections",
    sections=("left", "right"),
)
LAX = FeatureSpec(name="lax", summary="Takes anything.", target="m:F", config=f"{__name__}:Lax")
"""Its model does not ask for strict values."""


def _models() -> None:
    """Make the models importable for `config` of the descriptors."""
    import sys
    import types

    from pydantic import BaseModel, Field

    from roboneuron import Section

    class RecorderSection(Section):
        rate_hz: float = Field(default=30.0, gt=0, description="rate")

    class Left(Section):
        depth: int = 1

    class PairSections(Section):
        left: Left = Left()
        right: tuple[Left, ...] = Field(default=(), strict=False)

    class Lax(BaseModel):
        port: int = 1
        is_on: bool = False

    module = sys.modules.setdefault(__name__, types.ModuleType(__name__))
    module.RecorderSection, module.PairSections = RecorderSection, PairSections  # type: ignore[attr-defined]
    module.Lax = Lax  # type: ignore[attr-defined]


_models()
REGISTRY = fake_registry(RECORDER, PAIR, LAX)


def test_a_section_is_read_into_the_features_own_model():
    config = parse_config(
        f"{ROBOT}[run_recorder]\nrate_hz = 5.0\n[[right]]\ndepth = 4\n", registry=REGISTRY
    )
    assert feature_options(RECORDER, config).rate_hz == 5.0
    assert [entry.depth for entry in feature_options(PAIR, config).right] == [4]
    assert feature_options(PAIR, parse_config(ROBOT)).left.depth == 1


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("[run_recorde]\n", "unknown key 'run_recorde'. Did you mean 'run_recorder'?"),
        ("[supervisr]\n", "unknown key 'supervisr'. Did you mean 'supervisor'?"),
        (
            "[run_recorder]\nrate = 3.0\n",
            "unknown key 'run_recorder.rate'. Did you mean 'rate_hz'?",
        ),
        (
            "[run_recorder]\nrate_hz = -1.0\n",
            "run_recorder.rate_hz = -1.0: input should be greater than 0",
        ),
        ("[lax]\nport = true\n", "lax.port = True: input should be a valid integer"),
        ('[lax]\nport = "80"\n', "lax.port = '80': input should be a valid integer"),
        ("[lax]\nis_on = 1\n", "lax.is_on = 1: input should be a valid boolean"),
        ("[left]\ndeep = 3\n", "unknown key 'left.deep'. Did you mean 'depth'?"),
        ("[[right]]\ndepth = 'x'\n", "right.0.depth = 'x'"),
        ("sections = 3\n", "unknown key 'sections'"),
    ],
)
def test_what_is_wrong_is_named_with_the_nearest_valid_key(text, fault):
    whole = text + ROBOT if not text.startswith("[") else ROBOT + text
    with pytest.raises(ConfigurationError) as caught:
        parse_config(whole, registry=REGISTRY)
    assert fault in str(caught.value)


def test_a_section_of_a_feature_that_cannot_be_used_says_why():
    offer = Offer(
        spec=RECORDER,
        plugin="rn-recorder",
        distribution="rn-recorder",
        status=Status.UNAVAILABLE,
        reason="Needs 'mcap'.",
    )
    registry = Registry(plugins=(), all_offers=(offer,))
    with pytest.raises(
        ConfigurationError,
        match=r"'run_recorder': The feature 'run-recorder' cannot be used.*Needs 'mcap'",
    ):
        parse_config(f"{ROBOT}[run_recorder]\n", registry=registry)


def test_modules_are_not_told_the_sections_of_features():
    config = parse_config(f"{ROBOT}[run_recorder]\nrate_hz = 5.0\n", registry=REGISTRY)
    settings = ModuleSettings(kind="robot", node_name="robot", config=config, state_directory="x")
    again = ModuleSettings.model_validate_json(settings.model_dump_json())
    assert again.config.sections == {}
    assert again.config.robot == config.robot


def test_the_section_of_a_package_that_is_absent_names_the_package():
    with pytest.raises(
        ConfigurationError,
        match=r"'http': There is no feature 'http' installed; .*rn-standard.* Run: pip install",
    ):
        parse_config(f"{ROBOT}[http]\nport = 1\n", registry=REGISTRY)
