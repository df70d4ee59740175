"""A model is asked on the machine that the configuration or the client names."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from types import ModuleType, SimpleNamespace
from typing import Annotated, Any

import pytest
from pydantic import BaseModel, ConfigDict

from rn_testing.fakes import fake_registry
from roboneuron import (
    ConfigurationOnly,
    ControlSpace,
    InvalidInputError,
    RobotProfile,
    robot_space,
)
from roboneuron.config import Config, parse_config
from roboneuron.errors import ConfigurationError
from roboneuron.gate.roles import Role
from roboneuron.plugins.specs import BackendSpec
from roboneuron.selection.choosing import choose
from roboneuron.selection.feature import SelectionFeature
from roboneuron.selection.options import SelectionSections
from roboneuron.selection.requests import StartChosenInference


class Asking(BaseModel):
    model_config = ConfigDict(extra="forbid")
    address: Annotated[str, ConfigurationOnly()] = ""
    model: Annotated[str, ConfigurationOnly()] = ""
    space: Annotated[Any, ConfigurationOnly()] = None
    coding: str = "auto"


def positions(options: Mapping[str, object], profile: RobotProfile) -> ControlSpace:
    return robot_space("joint_position", profile, 20.0)


@pytest.fixture(autouse=True)
def _module(monkeypatch: pytest.MonkeyPatch) -> None:
    module: Any = ModuleType("asking_of_this_test")
    module.Asking, module.positions = Asking, positions
    monkeypatch.setitem(sys.modules, module.__name__, module)


REGISTRY = fake_registry(
    BackendSpec(
        name="asking",
        summary="Asks a server.",
        target="nowhere:X",
        config="asking_of_this_test:Asking",
    ),
    BackendSpec(
        name="jointed",
        summary="Yields positions.",
        target="nowhere:X",
        space="asking_of_this_test:positions",
    ),
)
CONFIGURATION = """
[robot]
name = "gantry"
[inference]
backend = "instant"
max_image_age_s = 0.7
[hosts.gpu]
address = "gpu:7420"
backend = "asking"
options = { coding = "raw" }
[hosts.attic]
address = "10.0.0.9:7420"
backend = "asking"
[models.near]
backend = "instant"
fallback = "asking"
[models.far]
backend = "not-installed-here"
checkpoint = "/only/there"
host = "gpu"
[models.arm]
backend = "jointed"
"""


def chosen(request: dict[str, Any]) -> tuple[Config, Mapping[str, str]]:
    config = parse_config(CONFIGURATION)
    arguments = StartChosenInference(**{"options": {}, **request})
    made = choose("inference", config, REGISTRY, arguments, Role.OPERATOR)
    return made.config, made.names


def test_a_model_runs_on_the_machine_of_its_table() -> None:
    config, names = chosen({"model": "far"})
    assert config.inference is not None
    assert config.inference.backend == "asking"
    assert config.inference.checkpoint is None
    assert config.options("asking") == {
        "address": "gpu:7420",
        "model": "far",
        "coding": "raw",
    }
    assert (names["model"], names["host"]) == ("far", "gpu")


def test_a_client_names_another_machine() -> None:
    config, names = chosen({"model": "far", "host": "attic"})
    assert config.options("asking") == {"address": "10.0.0.9:7420", "model": "far"}
    assert names["host"] == "attic"


def test_a_model_without_a_machine_runs_here() -> None:
    config, names = chosen({"model": "near"})
    assert config.inference is not None
    assert config.inference.backend == "instant"
    assert config.inference.max_image_age_s == 0.7
    assert config.inference.fallback == "asking"
    assert "host" not in names


def test_the_space_of_a_model_that_is_known_here_travels_with_its_name() -> None:
    config, _ = chosen({"model": "arm", "host": "gpu"})
    space = config.options("asking")["space"]
    assert isinstance(space, dict)
    assert (space["kind"], space["rate_hz"]) == ("joint_position", 20.0)
    assert space["channels"][-1] == "gripper_open"


@pytest.mark.parametrize(
    ("request_", "said", "path"),
    [
        (
            {"model": "far", "host": "moon"},
            "There is no machine 'moon'. The configuration has: gpu",
            "host",
        ),
        ({"host": "gpu"}, "name that too", "host"),
        ({"model": "none"}, "There is no model 'none'", "model"),
        ({"model": "far", "backend": "asking"}, "names its backend itself", "backend"),
        (
            {"model": "far", "host": "gpu", "checkpoint": "/etc"},
            "its checkpoint itself",
            "checkpoint",
        ),
    ],
)
def test_what_is_not_in_the_configuration_is_refused(
    request_: dict[str, Any], said: str, path: str
) -> None:
    with pytest.raises(InvalidInputError) as caught:
        chosen(request_)
    assert said in str(caught.value)
    assert caught.value.path == path


@pytest.mark.parametrize("address", ["gpu", "gpu:port", "http://gpu:1", "gpu:7420/x", ""])
def test_an_address_is_a_host_and_a_port(address: str) -> None:
    with pytest.raises(ConfigurationError, match=r"hosts\.gpu\.address.*such as gpu:7420"):
        parse_config(f'[robot]\nname = "gantry"\n[hosts.gpu]\naddress = "{address}"\n')


@pytest.mark.parametrize(
    ("host", "problem"), [("gpu", ""), ("cellar", "There is no machine 'cellar'")]
)
def test_a_model_of_a_machine_that_cannot_serve_it_is_left_out(host: str, problem: str) -> None:
    config = parse_config(CONFIGURATION.replace('host = "gpu"', f'host = "{host}"'))
    feature = SelectionFeature(SelectionSections.model_validate(config.sections))
    feature.start_forms(SimpleNamespace(config=config, registry=REGISTRY))  # type: ignore[arg-type]
    assert [problem in told and "models.far" in told for told in feature.omitted] == (
        [True] if problem else []
    )
