"""`roboneuron runs import`: bags of other recorders as a LeRobot data set, by the command."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
from argparse import ArgumentParser
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
from bag_expectations import expected
from lab_bags import Event, joint_state, lab_events, mapping_text, picture, raw_image, write_bag
from policy_world import JOINTS, RATE_HZ, ROWS, STATE_JOINTS, STATE_OPENINGS, recorded
from policy_world import picture as course_picture

from rn_recorder_policy.command import CheckPolicy, read_demonstration
from rn_recorder_runs.command import Runs
from rn_testing.fakes.site import plugin_site
from roboneuron import GRIPPER

ROOT = Path(__file__).parents[3]
LEROBOT = ROOT / ".venv-lerobot" / "bin" / "python"
needs_lerobot = pytest.mark.skipif(
    not (ROOT / ".venv-lerobot" / ".ready").exists(),
    reason="lerobot's environment is not there: make .venv-lerobot",
)
Call = Callable[..., tuple[int, str, str]]


@pytest.fixture
def call(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Call:
    """Import bags with a mapping into `set`; status and both outputs."""

    def run(mapping: str, *bags: Path, codec: str = "h264") -> tuple[int, str, str]:
        (tmp_path / "map.toml").write_text(mapping)
        parser = ArgumentParser()
        command = Runs()
        command.configure(parser)
        words = ["import", *map(str, bags), "--map", str(tmp_path / "map.toml")]
        words += ["--lerobot", str(tmp_path / "set"), "--codec", codec]
        status = command.run(parser.parse_args(words))
        return status, *capsys.readouterr()

    return run


def lab_bags(tmp_path: Path) -> list[Path]:
    """The same recording in both storages, and a folder that is no bag."""
    (tmp_path / "notes").mkdir()
    events = lab_events("jpeg", "trajectory", "text")
    bags = [write_bag(tmp_path / storage, storage, events) for storage in ("mcap", "sqlite3")]
    return [*bags, tmp_path / "notes"]


def test_bags_of_both_storages_become_one_data_set(call: Call, tmp_path: Path) -> None:
    status, out, err = call(mapping_text("trajectory", "text"), *lab_bags(tmp_path))
    wanted = expected("trajectory", "text") * 2
    rows = [row for one in wanted for row in one.rows]
    assert status == 1
    assert f"{len(wanted)} episodes, {len(rows)} frames at 20 Hz" in out
    for told in ("notes is no bag", "jumps back by 4.980 s", "/lab/cam is silent"):
        assert told in err
    table = pq.read_table(tmp_path / "set/data/chunk-000/file-000.parquet").to_pydict()
    assert table["roboneuron.row_ns"] == [row[0] for row in rows]
    for name, place in (("observation.state", 1), ("action", 2)):
        np.testing.assert_array_equal(table[name], np.float32([row[place] for row in rows]))
    lengths = [len(one.rows) for one in wanted]
    assert table["episode_index"] == np.repeat(np.arange(len(wanted)), lengths).tolist()
    tasks = pq.read_table(tmp_path / "set/meta/tasks.parquet").to_pydict()["task"]
    assert [tasks[index] for index in table["task_index"]] == [
        one.instruction for one in wanted for _ in one.rows
    ]
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert info["robot_type"] == "lab_arm"
    for name in ("observation.state", "action"):
        assert info["features"][name]["names"] == ["elbow", "shoulder", "gripper"]
    path = tmp_path / "set/videos/observation.images.front/chunk-000/file-000.mp4"
    with av.open(str(path)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    for frame, row in zip(frames, rows, strict=True):
        # JPEG, then H.264 at crf 23; the next picture differs by more than 25
        assert np.abs(frame.astype(int) - picture(row[3])).mean() < 6
    origin = json.loads((tmp_path / "set/meta/roboneuron.json").read_text())
    assert [one["bag"] for one in origin["episodes"]] == ["mcap"] * 4 + ["sqlite3"] * 4
    assert len(origin["left_out"]) == err.count("Left out: ")
    assert origin["imported"]["episodes"] == {"topic": "/lab/task", "field": "data"}


def test_the_commands_of_the_page_import_and_check(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (ROOT / "docs" / "recording.md").read_text(encoding="utf-8")
    section = page.partition("## Bags of other recorders")[2].partition("\n## ")[0]
    (mapping,) = re.findall(r"```toml\n(.*?)```", section, re.DOTALL)
    (typed,) = re.findall(r"```bash\n(.*?)```", section, re.DOTALL)
    imported, checked = (shlex.split(line) for line in typed.splitlines())
    (tmp_path / "bags").mkdir()
    write_bag(tmp_path / "bags" / "one", "mcap", lab_events("h264", "trajectory", "text"))
    (tmp_path / imported[imported.index("--map") + 1]).write_text(mapping)
    monkeypatch.chdir(tmp_path)
    at = imported.index("bags/*")
    imported[at : at + 1] = map(str, Path().glob("bags/*"))
    parser = ArgumentParser()
    command = Runs()
    command.configure(parser)
    assert command.run(parser.parse_args([*imported[2:], "--codec", "h264"])) == 1
    parser = ArgumentParser()
    CheckPolicy().configure(parser)
    arguments = parser.parse_args(checked[checked.index("--dataset") :])
    read = read_demonstration(arguments.dataset, arguments.episode)
    assert read.instruction == "pick up"
    assert read.columns["action"].names == ("elbow", "shoulder", "gripper")


def test_a_whole_bag_gives_0(call: Call, tmp_path: Path) -> None:
    events = [one for one in lab_events("raw", "next_state") if one.topic != "/lab/cam"][:60]
    text = mapping_text("next_state").replace('[cameras.front]\ntopic = "/lab/cam"\n', "")
    status, out, err = call(text, write_bag(tmp_path / "bag", "mcap", events))
    assert (status, err) == (0, "")
    assert "1 episodes, 23 frames" in out


def test_check_policy_agrees_with_an_imported_bag(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The course of `policy_world`, as a lab has recorded it under its own names."""
    own = [f"motor_{number}" for number in range(len(JOINTS))]
    actions = recorded("joint_position")
    events: list[Event] = []
    for row in range(ROWS):
        at_ns = 10**18 + round(row * 1e9 / RATE_HZ)
        fingers = [float(0.08 * STATE_OPENINGS[row])]
        measured = [*map(float, STATE_JOINTS[row]), *fingers]
        events.append(Event(at_ns, "/cam", raw_image(course_picture(row), at_ns)))
        events.append(Event(at_ns, "/state", joint_state([*own, "jaw"], measured, at_ns)))
        asked = joint_state([*own, "jaw"], actions[row], at_ns)
        events.append(Event(at_ns + 20_000_000, "/asked", asked))
    names = dict(zip(own, JOINTS, strict=True))
    text = f"fps = {RATE_HZ:.0f}\n[cameras.front]\ntopic = '/cam'\n"
    for part, topic, finger in (
        ("state", "/state", "finger"),
        ("action", "/asked", GRIPPER),
    ):
        values = ", ".join(f"{a} = '{b}'" for a, b in {**names, "jaw": finger}.items())
        text += f"[[{part}]]\ntopic = '{topic}'\nvalues = {{ {values} }}\n"
    status, _, err = call(text, write_bag(tmp_path / "bag", "sqlite3", events), codec="av1")
    assert (status, err) == (0, "")
    monkeypatch.setenv("COLUMNS", "160")
    with plugin_site(tmp_path / "site") as site:
        site.install("rn-toy", "", value="policy_plugin")
        config = tmp_path / "roboneuron.toml"
        config.write_text(
            '[robot]\nname = "toy"\n[inference]\nbackend = "knowing"\n[control]\n'
            'controller = "toy"\n[plugins.knowing]\nkind = "joint_position"\n'
        )
        parser = ArgumentParser()
        command = CheckPolicy()
        command.configure(parser)
        words = ["--config", str(config), "--dataset", str(tmp_path / "set"), "--json"]
        status = command.run(parser.parse_args(words))
    told = json.loads(capsys.readouterr().out)
    assert (status, told["faults"], told["agrees"]) == (0, [], True)


@pytest.mark.slow
@needs_lerobot
def test_lerobot_loads_it_and_trains_an_act(call: Call, tmp_path: Path) -> None:
    call(mapping_text("trajectory", "text"), *lab_bags(tmp_path), codec="av1")
    rows = [row for one in expected("trajectory", "text") * 2 for row in one.rows]
    columns = {
        "row_ns": [row[0] for row in rows],
        "state": [row[1] for row in rows],
        "action": [row[2] for row in rows],
        "front": [picture(row[3]) for row in rows],
    }
    np.savez(tmp_path / "expected.npz", **columns)
    checker = Path(__file__).with_name("lerobot_act.py")
    command = [str(LEROBOT), str(checker), str(tmp_path / "set"), str(tmp_path / "expected.npz")]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=900, check=False, env={"PATH": "/usr/bin"}
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert f"{len(rows)} frames equal" in done.stdout
