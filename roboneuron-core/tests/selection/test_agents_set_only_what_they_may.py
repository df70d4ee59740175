"""Restricted options and paths of checkpoints are for the configuration; it may list exceptions."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Annotated, Any

import pytest
from pydantic import AliasChoices, BaseModel, ConfigDict, Field

from rn_testing.fakes import fake_registry
from roboneuron import ConfigurationOnly
from roboneuron.config import Config, parse_config
from roboneuron.errors import (
    CheckpointError,
    ConfigurationError,
    InvalidInputError,
    RefusedError,
)
from roboneuron.gate.roles import Role
from roboneuron.planning import Plan
from roboneuron.plugins.specs import BackendSpec
from roboneuron.selection.choosing import choose
from roboneuron.selection.feature import SelectionFeature
from roboneuron.selection.options import SelectionSections
from roboneuron.selection.permission import check_listed
from roboneuron.selection.requests import StartChosenInference


class Camera(BaseModel):
    model_config = ConfigDict(extra="forbid")
    device: Annotated[str, ConfigurationOnly()] = "none"
    rate_hz: float = 1.0


class Options(BaseModel):
    model_config = ConfigDict(extra="forbid")
    gain: float = 1.0
    url: Annotated[str, ConfigurationOnly()] = "ws://here"
    camera: Camera = Camera()
    key: Annotated[str, ConfigurationOnly()] = ""
    checkpoint: Annotated[Path | None, ConfigurationOnly()] = None
    ca_file: Annotated[str, ConfigurationOnly()] = Field(
        default="", validation_alias=AliasChoices("ca_file", "ca")
    )


class Heavy(BaseModel):
    model_config = ConfigDict(extra="forbid")
    checkpoint: Annotated[Path, ConfigurationOnly()]


@pytest.fixture(autouse=True)
def _module(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("options_of_this_test")
    for model in (Options, Heavy, Nested):
        setattr(module, model.__name__, model)
    monkeypatch.setitem(sys.modules, module.__name__, module)


REGISTRY = fake_registry(
    BackendSpec(
        name="distant",
        summary="Asks a server.",
        target="nowhere:X",
        config="options_of_this_test:Options",
    ),
    BackendSpec(
        name="nested",
        summary="Asks one too.",
        target="nowhere:X",
        config="options_of_this_test:Nested",
    ),
    BackendSpec(
        name="heavy",
        summary="Needs weights.",
        target="nowhere:X",
        config="options_of_this_test:Heavy",
        needs_checkpoint=True,
    ),
    BackendSpec(
        name="elsewhere",
        summary="Not here.",
        target="no_such_package.x:X",
        config="needs_absent:Options",
    ),
)
SECTION = (
    '[plugins.distant]\nurl = "ws://policy"\n[plugins.distant.camera]\ndevice = "/dev/video0"\n'
)


def configuration(more: str = "", selection: str = "") -> Config:
    return parse_config(f'[robot]\nname = "gantry"\n[selection]\n{selection}\n{more}')


def select(
    config: Config, options: dict[str, Any], role: str = Role.OPERATOR, backend: str = "distant"
) -> Plan:
    return choose(
        "inference", config, REGISTRY, StartChosenInference(backend=backend, options=options), role
    )


@pytest.mark.parametrize("role", ["", Role.OPERATOR, Role.ADMIN])
@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"url": "ws://evil"}, "plugins.distant.url"),
        ({"url": None}, "plugins.distant.url"),
        ({"camera": {"device": "/etc/shadow"}}, "plugins.distant.camera.device"),
        # a table is replaced: its device would go
        ({"camera": {"rate_hz": 2.0}}, "plugins.distant.camera.device"),
        ({"camera": None}, "plugins.distant.camera.device"),
        ({"camera": {"device": "/dev/video0", "gain": 1}}, "plugins.distant.camera.gain"),
        ({"ca": "theirs.pem"}, "plugins.distant.ca"),
        ({"ca_file": "theirs.pem"}, "plugins.distant.ca_file"),
    ],
)
def test_a_restricted_option_is_refused(options: dict[str, Any], named: str, role: str) -> None:
    with pytest.raises(RefusedError, match="Only the configuration may set") as caught:
        select(configuration(SECTION), options, role)
    assert named in caught.value.message
    assert "agent_options" in caught.value.hint


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"gain": 2.0},
        {"url": "ws://policy"},
        {"camera": {"device": "/dev/video0", "rate_hz": 2.0}},
    ],
)
def test_everything_else_may_be_set(options: dict[str, Any]) -> None:
    selection = select(configuration(SECTION), options)
    assert selection.config.options("distant")["url"] == "ws://policy"
    assert {key: selection.config.options("distant")[key] for key in options} == options


def test_an_admin_may_set_what_is_listed_and_nobody_else() -> None:
    config = configuration(SECTION, 'agent_options = ["distant.url", "distant.camera"]')
    options = {"url": "ws://other", "camera": {"device": "/dev/video1"}}
    assert select(config, options, Role.ADMIN).config.options("distant")["url"] == "ws://other"
    with pytest.raises(
        RefusedError, match=r"Only a client with the role 'admin' may set plugins\.distant\.url"
    ):
        select(config, options, Role.OPERATOR)
    with pytest.raises(RefusedError, match=r"Only the configuration may set plugins\.distant\.key"):
        select(config, {**options, "key": "/x"}, Role.ADMIN)


@pytest.mark.parametrize("role", ["", Role.OPERATOR, Role.ADMIN])
def test_a_checkpoint_among_the_options_is_refused_like_any_file(role: str) -> None:
    with pytest.raises(
        RefusedError, match=r"A checkpoint is no option for clients.*argument `checkpoint`"
    ):
        select(configuration(SECTION), {"checkpoint": "/models"}, role)


def test_options_of_a_plugin_that_cannot_be_imported_here_are_all_restricted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "needs_absent.py").write_text("import absent_library\n")
    monkeypatch.syspath_prepend(tmp_path)
    config = parse_config(
        '[robot]\nname = "gantry"\n[inference]\nbackend = "elsewhere"\npython = '
        '"/other/bin/python"\n'
    )
    with pytest.raises(RefusedError, match=r"plugins\.elsewhere\.gain"):
        select(config, {"gain": 2.0}, Role.ADMIN, "elsewhere")


def load(config: Config, checkpoint: Path | str) -> Plan:
    return choose(
        "inference",
        config,
        REGISTRY,
        StartChosenInference(backend="heavy", checkpoint=str(checkpoint)),
        Role.OPERATOR,
    )


def test_a_checkpoint_lies_where_the_configuration_says(tmp_path: Path) -> None:
    for name in ("named/step-100", "models/one", "other", "plugin"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "models" / "link").symlink_to(tmp_path / "other")
    config = configuration(
        f'[inference]\nbackend = "heavy"\ncheckpoint = "{tmp_path}/named"\n'
        f'[plugins.heavy]\ncheckpoint = "{tmp_path}/plugin"\n',
        f'checkpoint_roots = ["{tmp_path}/models"]',
    )
    for allowed in ("named", "named/step-100", "plugin", "models/one", "models/../named"):
        assert load(config, tmp_path / allowed).names["checkpoint"] == str(
            (tmp_path / allowed).absolute()
        )
    for barred in ("other", "", "models/../other", "models/link", "nothing", "models-2"):
        with pytest.raises(RefusedError, match="does not allow the checkpoint") as caught:
            load(config, tmp_path / barred)
        assert "checkpoint_roots" in caught.value.hint
    with pytest.raises(CheckpointError, match="does not exist"):
        load(config, tmp_path / "models" / "none")


def test_without_a_configured_checkpoint_none_may_be_named(tmp_path: Path) -> None:
    with pytest.raises(RefusedError, match="does not allow the checkpoint"):
        load(configuration(), tmp_path)
    with pytest.raises(InvalidInputError, match="needs a checkpoint"):
        select(configuration(), {}, backend="heavy")


@pytest.mark.parametrize("path", ["a\0b", "~no-such-user-at-all/x"])
def test_what_is_no_path_is_refused_as_a_checkpoint(path: str, tmp_path: Path) -> None:
    config = configuration(selection=f'checkpoint_roots = ["{tmp_path}"]')
    with pytest.raises((CheckpointError, RefusedError)):
        load(config, path)


class Server(BaseModel):
    hostname: Annotated[str, ConfigurationOnly()] = "127.0.0.1"


class Nested(BaseModel):
    server: Server = Server()
    gain: float = 1.0


@pytest.mark.parametrize(
    ("backend", "named"),
    [("distant", "plugins.distant.url"), ("nested", "plugins.nested.server.hostname")],
)
@pytest.mark.parametrize("role", ["", Role.OPERATOR, Role.ADMIN])
def test_an_agent_does_not_start_what_connects_to_an_address_that_nobody_wrote_down(
    backend: str, named: str, role: str
) -> None:
    with pytest.raises(
        RefusedError, match="default address that the configuration does not name"
    ) as caught:
        select(configuration(), {}, role, backend)
    assert named in caught.value.message


@pytest.mark.parametrize(
    "more",
    [
        SECTION,
        '[inference]\nbackend = "distant"\n',
        '[plugins.nested.server]\nhostname = "policy"\n',
        '[inference]\nbackend = "nested"\n',
    ],
)
def test_an_address_in_the_configuration_or_a_backend_that_it_chooses_may_be_started(
    more: str,
) -> None:
    backend = "nested" if "nested" in more else "distant"
    chosen = select(configuration(more), {}, backend=backend).config
    assert chosen.inference is not None
    assert chosen.inference.backend == backend


def test_an_admin_may_give_an_address_that_is_listed() -> None:
    config = configuration(selection='agent_options = ["distant.url"]')
    assert (
        select(config, {"url": "ws://here"}, Role.ADMIN).config.options("distant")["url"]
        == "ws://here"
    )


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("distnat.url", "nothing is called 'distnat'. Did you mean 'distant'?"),
        ("distant.ulr", "'distant' has no option 'ulr'. Did you mean 'url'?"),
    ],
)
def test_an_entry_of_agent_options_that_names_nothing_is_refused(entry: str, words: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        check_listed([entry], REGISTRY)
    assert words in str(caught.value)
    assert entry in str(caught.value)


def test_entries_of_agent_options_that_name_an_option_are_right() -> None:
    check_listed(["distant.camera.device", "distant.url", "elsewhere.anything"], REGISTRY)


def test_the_feature_checks_agent_options_before_the_server_starts() -> None:
    sections = SelectionSections.model_validate({"selection": {"agent_options": ["nowhere.url"]}})
    with pytest.raises(ConfigurationError, match="nowhere"):
        SelectionFeature(sections).start_forms(SimpleNamespace(registry=REGISTRY))  # type: ignore[arg-type]
