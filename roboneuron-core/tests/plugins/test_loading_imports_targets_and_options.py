"""Targets are imported and options validated, with errors that tell what to do."""

from __future__ import annotations

from pathlib import Path

import pytest

from roboneuron.errors import ConfigurationError, MissingDependencyError, PluginError
from roboneuron.plugins.loading import OLD_NAMES_END, load_options, load_target
from roboneuron.plugins.specs import BackendSpec, DriverSpec, Requirement

MODULE = """
from pathlib import Path
from pydantic import AliasChoices, BaseModel, ConfigDict, Field

class Options(BaseModel):
    model_config = ConfigDict(extra="forbid")
    gain: float = Field(
        default=1.0, gt=0, validation_alias=AliasChoices("gain", "factor", "scale")
    )
    checkpoint: Path | None = None
    sizes: tuple[int, ...] = ()

class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")
    checkpoint: Path
    inner: Options = Options()

class Servo: ...
"""


@pytest.fixture
def servo(site):
    (site.path / "servo_module.py").write_text(MODULE)
    return BackendSpec(
        name="servo", summary="S.", target="servo_module:Servo", config="servo_module:Options"
    )


def _spec(target, **more):
    return BackendSpec(name="x", summary="X.", target=target, **more)


def test_load_target_returns_the_class(servo):
    assert load_target(servo).__name__ == "Servo"


def test_load_target_of_a_driver(servo):
    assert (
        load_target(DriverSpec(name="d", summary="D.", target="servo_module:Servo")).__name__
        == "Servo"
    )


def test_load_target_names_the_nearest_attribute(servo):
    with pytest.raises(PluginError, match=r"no attribute 'Sevro'\. Did you mean 'Servo'"):
        load_target(_spec("servo_module:Sevro"))


def test_load_target_of_an_absent_module_is_a_plugin_error():
    with pytest.raises(PluginError, match="no module 'absent_package'"):
        load_target(_spec("absent_package.sub:Thing"))


def test_load_target_of_an_undeclared_dependency_says_what_is_missing(site):
    (site.path / "needs_more.py").write_text("import absent_dependency\n")
    with pytest.raises(MissingDependencyError, match="no module 'absent_dependency'"):
        load_target(_spec("needs_more:Thing"))


def test_load_target_of_a_declared_dependency_gives_the_command(site):
    (site.path / "needs_more.py").write_text("import absent_dependency\n")
    needs = (Requirement(module="absent_dependency", install="pip install absent"),)
    with pytest.raises(MissingDependencyError, match="Run: pip install absent"):
        load_target(_spec("needs_more:Thing", requires=needs))


def test_load_target_keeps_the_cause_of_a_failing_import(site):
    (site.path / "explodes.py").write_text("1 / 0\n")
    with pytest.raises(PluginError, match="ZeroDivisionError") as caught:
        load_target(_spec("explodes:Thing"))
    assert isinstance(caught.value.__cause__, ZeroDivisionError)


def test_load_options_reads_paths_and_tuples(servo):
    options = load_options(servo, {"gain": 2, "checkpoint": "/c", "sizes": [1, 2]})
    assert (options.gain, options.checkpoint, options.sizes) == (2.0, Path("/c"), (1, 2))
    assert load_options(servo, {"checkpoint": Path("/c")}).checkpoint == Path("/c")


def test_load_options_names_the_key_and_the_nearest(servo):
    with pytest.raises(
        ConfigurationError, match=r"unknown key 'plugins\.servo\.gian'\. Did you mean 'gain'\?"
    ):
        load_options(servo, {"gian": 2.0})


@pytest.mark.parametrize("old", ["factor", "scale"])
def test_an_old_key_is_read_with_a_warning(servo, old, caplog):
    assert load_options(servo, {old: 2.0}).gain == 2.0
    assert f"plugins.servo.{old} is called gain now" in caplog.text
    assert OLD_NAMES_END in caplog.text


def test_an_old_key_beside_the_present_one_is_refused(servo):
    with pytest.raises(ConfigurationError, match=r"unknown key 'plugins\.servo\.factor'"):
        load_options(servo, {"gain": 1.0, "factor": 2.0})


def test_load_options_uses_the_section_of_the_caller(servo):
    with pytest.raises(ConfigurationError, match=r"robot\.options\.gian"):
        load_options(servo, {"gian": 2.0}, section="robot.options")


@pytest.mark.parametrize(
    ("value", "words"), [("2", "valid number"), (True, "valid number"), (-1.0, "greater than 0")]
)
def test_load_options_refuses_wrong_types_and_ranges(servo, value, words):
    with pytest.raises(ConfigurationError, match=rf"plugins\.servo\.gain = {value!r}: .*{words}"):
        load_options(servo, {"gain": value})


def test_load_options_without_a_model_takes_none():
    assert load_options(_spec("m:X"), {}) is None
    with pytest.raises(
        ConfigurationError, match=r"plugins\.x\.gain is unknown: 'x' takes no options"
    ):
        load_options(_spec("m:X"), {"gain": 1})


def test_load_options_refuses_a_model_that_is_no_pydantic_model(servo):
    with pytest.raises(PluginError, match="expected a pydantic BaseModel"):
        load_options(_spec("m:X", config="servo_module:Servo"), {})


def test_load_options_names_what_is_required(servo):
    strict = _spec("m:X", config="servo_module:Strict")
    with pytest.raises(ConfigurationError, match=r"'plugins\.x\.checkpoint' is missing"):
        load_options(strict, {})


def test_load_options_refuses_unknown_keys_inside_sections(servo):
    strict = _spec("m:X", config="servo_module:Strict")
    with pytest.raises(
        ConfigurationError, match=r"unknown key 'plugins\.x\.inner\.gian'\. Did you mean 'gain'\?"
    ):
        load_options(strict, {"checkpoint": "/c", "inner": {"gian": 2}})


def test_load_options_refuses_what_no_configuration_can_hold(servo):
    with pytest.raises(ConfigurationError, match="expected what a TOML file can hold"):
        load_options(servo, {"checkpoint": object()})
