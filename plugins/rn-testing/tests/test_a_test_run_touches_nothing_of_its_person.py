"""A run of pytest with the project's plugin, started by a person with files and settings of their
own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from rn_testing.isolation import KEPT, is_personal, persons_bounds
from rn_testing.landlock import ALL, READ, WriteBounds, is_available

ROOT = Path(__file__).parents[3]
STATE = ".local/state/roboneuron"
FILES = {
    f"{STATE}/emergency_stop.latched": '{"reason": "a person pressed it"}',
    f"{STATE}/limits.tightened.json": '{"max_speed_m_s": 0.001}',
    f"{STATE}/maintenance.json": '{"who": "a person"}',
    f"{STATE}/audit.jsonl": "",
    ".config/roboneuron/tokens.toml": "",
    ".cache/roboneuron/interfaces/x": "",
    ".local/share/roboneuron/interfaces/x": "",
    ".ros/log/x": "",
    "own/state/roboneuron/emergency_stop.latched": "{}",
    "own/roboneuron.toml": "",
}
SETTINGS = {
    "ROS_DOMAIN_ID": "7",
    "ROS_LOCALHOST_ONLY": "1",
    "ROBONEURON_TOKEN": "secret",
    "ROBONEURON_RECORDER": "on",
    "ROBONEURON_FUZZ_CALLS": "3",
    "AMENT_PREFIX_PATH": "/opt/ros/kilted",
    "FASTRTPS_DEFAULT_PROFILES_FILE": "/theirs.xml",
    "PYTHONPATH": "/opt/ros/kilted/lib/python3.12/site-packages",
    "PYTHONWARNINGS": "ignore",
    "FORCE_COLOR": "1",
    "HTTP_PROXY": "http://proxy.invalid:3128",
}
WAYS = {
    "open": "open(path, 'w')",
    "append": "open(path, 'a')",
    "truncate": "os.truncate(path, 0)",
    "unlink": "os.unlink(path)",
    "rename": "os.rename(path, path + '.reset')",
    "move in": "os.rename(str(tmp_path / 'new'), path)",
    "move out": "os.rename(path, str(tmp_path / 'new'))",
    "link": "os.link(path, path + '.2')",
    "symlink": "os.symlink(path, path + '.2')",
    "mkdir": "os.mkdir(path + '.d')",
    "new file": "open(path + '.new', 'w')",
    "socket": "socket.socket(socket.AF_UNIX).bind(path + '.s')",
    "program": "subprocess.run(['touch', path + '.new'], check=True)",
    "shell without environment": "subprocess.run(f': > {path}', shell=True, env={}, check=True)",
    "isolated Python": "subprocess.run([sys.executable, '-I', '-c', f'open({path!r}, \"w\")'], "
    "env={}, check=True)",
    "thread": "in_a_thread(lambda: open(path, 'w'))",
}
TRIED = """
import concurrent.futures, json, os, pathlib, socket, subprocess, sys
import pytest

def in_a_thread(function):
    with concurrent.futures.ThreadPoolExecutor() as pool:
        pool.submit(function).result()

@pytest.mark.parametrize("name", {files!r})
@pytest.mark.parametrize("way", {ways!r})
def test_a_write_is_refused(tmp_path, way, name):
    (tmp_path / "new").touch()
    path = os.path.join({home!r}, name)
    with pytest.raises((OSError, subprocess.CalledProcessError)):
        eval(way, {{**globals(), "path": path, "tmp_path": tmp_path}})

@pytest.mark.parametrize("name", {hidden!r})
def test_nobody_can_look(name):
    with pytest.raises(PermissionError):
        open(os.path.join({home!r}, name)).read()

def test_what_this_run_sees():
    home = pathlib.Path.home()
    (home / ".local/state/roboneuron").mkdir(parents=True)
    with pathlib.Path({told!r}).open("a") as file:
        file.write(json.dumps({{"home": str(home), "environment": dict(os.environ)}}) + "\\n")
"""


class Person:
    """Somebody with a home below `folder`."""

    def __init__(self, folder: Path) -> None:
        self.home = folder / "home"
        self.folder = folder
        self.told = folder / "tmp" / "told.jsonl"
        self.told.parent.mkdir(parents=True)
        for name, text in FILES.items():
            path = self.home / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)

    def files(self) -> dict[str, tuple[bytes, int]]:
        """Content and time of every file and folder."""
        return {
            str(path.relative_to(self.home)): (
                b"" if path.is_dir() else path.read_bytes(),
                path.stat().st_mtime_ns,
            )
            for path in [self.home, *self.home.rglob("*")]
        }

    def pytest(self, *arguments: str, **settings: str) -> subprocess.CompletedProcess[str]:
        """Run pytest as this person."""
        inherited = {name: os.environ[name] for name in ("PATH", "LANG") if name in os.environ}
        return subprocess.run(
            [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments],
            env={
                **inherited,
                "HOME": str(self.home),
                "TMPDIR": str(self.folder / "tmp"),
                "XDG_STATE_HOME": str(self.home / "own" / "state"),
                **settings,
            },
            cwd=self.folder,
            capture_output=True,
            text=True,
            timeout=150,
            check=False,
        )


@pytest.fixture
def person(tmp_path: Path) -> Person:
    return Person(tmp_path)


needs_landlock = pytest.mark.skipif(not is_available(), reason="this kernel has no Landlock")


def tries(person: Person, ways: list[str], names: list[str]) -> str:
    file = person.folder / "test_tried.py"
    hidden = [name for name in FILES if "/roboneuron/" in name or ".ros" in name]
    told = str(person.told)
    file.write_text(
        TRIED.format(files=names, ways=ways, hidden=hidden, home=str(person.home), told=told)
    )
    return str(file)


@needs_landlock
@pytest.mark.parametrize("workers", ["0", "2"])
@pytest.mark.sampled(every=2)
def test_whoever_tries_cannot_write_there(person: Person, workers: str) -> None:
    file = tries(person, list(WAYS.values()), [*FILES, "new"])
    before = person.files()
    done = person.pytest("-p", "rn_testing.isolation", "-n", workers, file, **SETTINGS)
    assert done.returncode == 0, done.stdout + done.stderr
    assert person.files() == before
    told = json.loads(person.told.read_text())
    seen = told["environment"]
    assert not Path(told["home"]).exists(), "the home of a run is removed with it"
    assert Path(told["home"]) != person.home
    kept = {"ROBONEURON_FUZZ_CALLS", "HTTP_PROXY"}
    assert {name for name in SETTINGS if seen.get(name) == SETTINGS[name]} == kept
    assert "127.0.0.1" in seen["NO_PROXY"]
    assert not [name for name, value in seen.items() if str(person.home) in value]


@pytest.mark.exhaustive
def test_without_the_guard_the_same_attempts_succeed(person: Person) -> None:
    file = tries(person, [WAYS["append"], WAYS["program"]], ["own/roboneuron.toml", "new"])
    before = person.files()
    done = person.pytest("-p", "rn_testing.isolation", "--unguarded", file)
    assert done.returncode == 1
    assert set(person.files()) - set(before) == {"new", "new.new", "own/roboneuron.toml.new"}


@pytest.mark.skipif(sys.platform != "linux", reason="mounts are those of Linux")
def test_what_mounts_is_free_of_the_guard(
    run_unguarded: Callable[[Callable[[], int]], int], tmp_path: Path
) -> None:
    command = ["unshare", "-rm", "mount", "-t", "tmpfs", "none", str(tmp_path)]
    if run_unguarded(lambda: subprocess.run(command, check=False).returncode):
        pytest.skip("this machine lets nobody mount")
    assert subprocess.run(command, check=False).returncode != 0 or not is_available()


@pytest.mark.exhaustive
@pytest.mark.timeout(180)
def test_simulated_calls_pass_beside_a_pressed_stop_of_the_person(person: Person) -> None:
    before = person.files()
    done = person.pytest(
        str(ROOT / "tests" / "test_simulated_calls_move_nothing.py"), f"-c{ROOT}/pyproject.toml"
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert person.files() == before


def test_the_person_is_found_however_little_the_environment_says(tmp_path: Path) -> None:
    bounds = persons_bounds({"XDG_CONFIG_HOME": str(tmp_path)}, {})
    assert tmp_path / "roboneuron" in bounds.hidden
    assert any(path.name == ".ros" for path in bounds.hidden) or Path.home() == Path("/")


def test_variables_that_lanes_give_are_kept() -> None:
    assert not any(is_personal(name) for name in (*KEPT, "PATH", "LANG", "TMPDIR", "HF_HOME"))
    assert all(is_personal(name) for name in ("ROBONEURON_LINK", "ROS_DOMAIN_ID", "XDG_DATA_HOME"))


@pytest.mark.parametrize(
    ("path", "rights"),
    [
        ("other", ALL),
        ("home/code", ALL),
        ("home/file", READ),
        ("home/.local/share", READ),
        ("home/.local/state/other", READ),
        ("home/.local/state/roboneuron", None),
        ("home", None),
        ("link", None),
    ],
)
def test_the_rights_of_a_path_are_those_of_the_nearest_rule(
    tmp_path: Path, path: str, rights: int | None
) -> None:
    home, state = tmp_path / "home", tmp_path / "home/.local/state"
    for folder in ("other", "home/code", "home/.local/share", "home/.local/state/other"):
        (tmp_path / folder).mkdir(parents=True)
    (home / "file").touch()
    (state / "roboneuron").mkdir()
    (tmp_path / "link").symlink_to(home)
    bounds = WriteBounds(
        read_only=frozenset({home}),
        hidden=frozenset({state / "roboneuron", home / ".ros"}),
        writable=frozenset({home / "code"}),
    )
    assert bounds.grants(tmp_path).get(tmp_path / path) == rights
