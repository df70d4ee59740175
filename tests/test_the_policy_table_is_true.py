"""The table of public policies in docs/vla.md: each row's lines give a valid configuration, its
space is that of the row, and a checkpoint of that kind loads.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import two_arms_plugin
from plugin_site import installed

from rn_backend_oft.constants import CONSTANTS
from rn_backend_oft.tiny import make_tiny_oft
from rn_backend_pi0.tiny import make_tiny
from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.runtime import TorchRuntime
from rn_vla.openvla.tiny import make_tiny as make_tiny_openvla
from roboneuron.cli.main import main
from roboneuron.config import parse_config
from roboneuron.contract import Backend
from roboneuron.errors import ConfigurationError
from roboneuron.modules.inference.agreement import SpaceAgreement
from roboneuron.modules.plugin import build
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import BackendSpec

PAGE = (Path(__file__).parents[1] / "docs" / "vla.md").read_text(encoding="utf-8")
ROBOTS = {0: "fr3", 6: "one-arm", 7: "fr3", 12: "two-arms"}
"""Robot by the number of joints in a row."""
CONFIG = """
[robot]
name = "{robot}"
[perception]
source = "{cameras}"
[inference]
backend = "{backend}"
{checkpoint}
[control]
controller = "urdf"
[plugins.{backend}]
{options}
"""


@dataclass(frozen=True)
class Row:
    """One policy of the table.

    Attributes:
        policy, backend, space: as in the table.
        options: lines of TOML, with the number of joints instead of their names.
        joints: this number; 0 for none.
    """

    policy: str
    backend: str
    options: tuple[str, ...]
    space: str

    @property
    def joints(self) -> int:
        found = re.search(r"^joints=\[(\d+)\]$", "\n".join(self.options), flags=re.MULTILINE)
        return int(found[1]) if found else 0

    def option(self, name: str) -> object:
        """Value of an option in the row, or None."""
        return tomllib.loads("\n".join(self.options)).get(name)


def table() -> list[Row]:
    """The rows of the page."""
    section = PAGE.partition("## Which policy needs which lines")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| ([^|]+) \| `([\w-]+)` \| (`.*`) \| `(.+)` \|$", section, re.MULTILINE)
    return [
        Row(policy, backend, tuple(re.findall(r"`([^`]+)`", options)), space)
        for policy, backend, options, space in rows
    ]


ROWS = table()


@pytest.fixture(scope="module")
def registry(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Registry]:
    """The installed plugins, plus robots with six joints per arm."""
    folder = tmp_path_factory.mktemp("installed")
    plugin = two_arms_plugin.PLUGIN
    with installed(folder, "rn-two-arms", (plugin,), source=Path(__file__).parent):
        yield discover()


def write_checkpoint(row: Row, folder: Path) -> None:
    """Write a tiny checkpoint of the row's kind."""
    profile = str(row.option("profile"))
    if row.backend == "openvla":
        make_tiny_openvla(folder)
    elif row.backend.startswith("oft"):
        constants = str(row.option("constants"))
        make_tiny_oft(folder, platform=constants if constants in CONSTANTS else "libero")
    else:
        is_fast = row.backend == "pi0-fast"
        is_05 = "pi05" in row.policy and "pi0_" not in row.policy
        layout = "lerobot" if "LeRobot" in row.policy else "openpi"
        kind = profile if profile != "libero-openpi" else "libero"
        variant = "pi0_fast" if is_fast else "pi05" if is_05 else "pi0"
        make_tiny(folder, layout=layout, variant=variant, profile=kind)
        if row.option("asset_id"):
            (folder / "assets" / "tiny").rename(folder / "assets" / str(row.option("asset_id")))


def test_the_table_has_every_profile_and_every_backend_of_policies() -> None:
    assert len(ROWS) >= 19
    assert len({row.policy for row in ROWS}) == len(ROWS)
    backends = {row.backend for row in ROWS}
    assert backends == {
        "pi0",
        "pi0-fast",
        "openpi",
        "openvla",
        "oft",
        "oft-primary",
        "oft-pair",
    }
    told = {row.option("profile") for row in ROWS if row.backend == "pi0"}
    assert told == {
        *("libero", "libero-openpi", "droid", "droid-position", "franka", "ur5e"),
        *("aloha", "aloha-absolute", "aloha-plain", "aloha-plain-absolute"),
    }


@pytest.mark.exhaustive
@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("row", ROWS, ids=[row.policy for row in ROWS])
def test_the_lines_of_a_row_are_all_that_its_policy_needs(
    registry: Registry, tmp_path: Path, capsys: pytest.CaptureFixture[str], row: Row
) -> None:
    robot = ROBOTS[row.joints]
    joints = {
        "two-arms": two_arms_plugin.JOINTS,
        "one-arm": two_arms_plugin.ARM,
        "fr3": tuple(f"fr3_joint{i}" for i in range(1, 8)),
    }[robot]
    checkpoint = tmp_path / "checkpoint"
    if row.backend != "openpi":
        write_checkpoint(row, checkpoint)
        (checkpoint / "roboneuron.json").unlink(missing_ok=True)
    options = "\n".join(row.options).replace(f"[{row.joints}]", json.dumps(joints))
    text = CONFIG.format(
        robot=robot,
        backend=row.backend,
        options=options,
        cameras="fr3-sim-camera" if robot == "fr3" else "grey",
        checkpoint="" if row.backend == "openpi" else f'checkpoint = "{checkpoint}"',
    )
    file = tmp_path / "roboneuron.toml"
    file.write_text(text, encoding="utf-8")
    assert main(["config", "check", str(file)]) == 0, capsys.readouterr().err
    config = parse_config(text, registry=registry)
    spec = registry.get(BackendSpec, row.backend)
    given = {**config.options(row.backend), "checkpoint": str(checkpoint)}
    agreement = SpaceAgreement.of(registry, spec, given, robot, config.control)
    label = agreement.executed.label.partition(":")[0]
    assert label.removesuffix("_base") == row.space
    if row.backend == "openpi":
        return
    if row.option("constants") == "own":
        assert agreement.executed.size == 7  # its head differs from that of a tiny checkpoint
        return
    runtime = None
    if spec.default_runtime:
        runtime = TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="float32"))
    backend = build(spec, given, runtime=runtime)
    assert isinstance(backend, Backend)
    backend.load()
    backend.close()


JOINT_ROWS = [row for row in ROWS if row.joints]


@pytest.mark.parametrize("row", JOINT_ROWS, ids=[row.policy for row in JOINT_ROWS])
def test_a_policy_of_joints_is_refused_without_their_names(registry: Registry, row: Row) -> None:
    spec, robot = registry.get(BackendSpec, row.backend), ROBOTS[row.joints]
    options = tomllib.loads("\n".join(row.options))
    del options["joints"]
    with pytest.raises(ConfigurationError, match="needs the option 'joints'"):
        SpaceAgreement.of(registry, spec, options, robot, None)


def test_arms_of_six_joints_are_refused_on_two_fr3s(
    registry: Registry, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joints = [f"{arm}_fr3_joint{i}" for arm in ("left", "right") for i in range(1, 7)]
    text = CONFIG.format(
        robot="fr3-pair",
        cameras="fr3-pair-sim-camera",
        backend="oft-pair",
        checkpoint=f'checkpoint = "{tmp_path}"',
        options=f'profile = "joints"\nconstants = "aloha"\nproprio = true\njoints = {joints}',
    )
    (tmp_path / "roboneuron.toml").write_text(text, encoding="utf-8")
    assert main(["config", "check", str(tmp_path / "roboneuron.toml")]) == 2
    told = capsys.readouterr().err
    assert "the backend lacks left/left_fr3_joint7, right/right_fr3_joint7" in told
    arms = (Path(__file__).parents[1] / "docs" / "action-spaces.md").read_text(encoding="utf-8")
    assert "`the backend lacks left/left_fr3_joint7, right/right_fr3_joint7`" in arms
