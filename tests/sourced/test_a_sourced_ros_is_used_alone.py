"""A shell with a sourced ROS of another distribution, and a workspace with its own types: server
and modules use either it or the wheels, never parts of both.
"""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import anyio
import psutil
import pytest
from mcp import Client, StdioServerParameters

from rn_testing.agent import Agent
from rn_testing.domain import free_ros_domain
from rn_testing.waiting import wait_for_line

ROOT = Path(__file__).parents[2]
KILTED = ROOT / ".venv-kilted"
ROS = KILTED / "opt" / "ros" / "kilted"
SETUP = KILTED / "workspace" / "install" / "setup.bash"
SOURCED = ROOT / ".venv-sourced"
OWN = ROOT / ".venv"
WAIT_S = 60.0
"""Time limit for other processes, on a busy machine."""
OF_DDS = re.compile(r"/lib(fastrtps|fastdds)\.so")
pytestmark = [
    pytest.mark.ros,
    pytest.mark.sourced,
    pytest.mark.timeout(400),
    pytest.mark.skipif(
        not (SETUP.is_file() and (SOURCED / "bin" / "roboneuron").is_file()),
        reason="`make test-sourced` sets up .venv-kilted and .venv-sourced",
    ),
]
CONFIG = """
[robot]
name = "fr3"
[ros]
installation = "{installation}"
[supervisor]
state_directory = "{state}"
"""
OWN_TYPES = """
[[expose]]
name = "seam"
kind = "publish"
topic = "seam"
type = "own_msgs/msg/Seam"
moves = false
bounds = { "offset" = [-0.5, 0.5] }
[[expose]]
name = "heard"
kind = "read"
topic = "heard"
type = "std_msgs/msg/String"
[[expose]]
name = "strike"
kind = "service"
topic = "strike"
type = "own_msgs/srv/Strike"
moves = false
"""


@pytest.fixture
def shell() -> dict[str, str]:
    """Variables of a new shell, without a sourced ROS or set-up wheels."""
    of_ros = (
        "ROS",
        "AMENT",
        "FAST",
        "ROBONEURON",
        "_ROS",
        "LD_LIBRARY",
        "PYTHONPATH",
        "MAKE",
        "MFLAGS",
    )
    kept = {name: value for name, value in os.environ.items() if not name.startswith(of_ros)}
    return {**kept, "ROS_DOMAIN_ID": str(free_ros_domain())}


def in_sourced_shell(*words: str, setup: Path = SETUP) -> list[str]:
    """A command line that first sources the workspace, and the ROS below it."""
    return ["bash", "-c", '. "$0" && exec "$@"', str(setup), *words]


def configuration(folder: Path, installation: str, more: str = "") -> Path:
    """A configuration of a simulated arm."""
    path = folder / "roboneuron.toml"
    path.write_text(CONFIG.format(installation=installation, state=folder / "state") + more)
    return path


def loaded(process: psutil.Process) -> set[Path]:
    """Libraries in the folders of either ROS that a process has loaded."""
    maps = Path(f"/proc/{process.pid}/maps").read_text().splitlines()
    paths = {Path(line.split(maxsplit=5)[-1]) for line in maps if ".so" in line}
    return {path for path in paths if re.match(r"lib(rcl|rmw|fast|rosidl)", path.name)}


def check_alone(process: psutil.Process, root: Path, *others: Path) -> None:
    """Check a process that uses ROS: one Fast DDS, and no library from outside these folders."""
    libraries = loaded(process)
    assert len({path for path in libraries if OF_DDS.search(str(path))}) == 1, libraries
    outside = [
        path
        for path in libraries
        if not any(path.is_relative_to(folder) for folder in (root, *others))
    ]
    assert not outside, process.cmdline()


async def check_processes(server: Callable[[], psutil.Process], *roots: Path) -> None:
    """Check that the server's and its robot module's libraries are in these folders."""
    processes = [server(), *server().children(recursive=True)]
    with_ros = [process for process in processes if loaded(process)]
    assert any("roboneuron.modules" in process.cmdline() for process in with_ros)
    assert len(with_ros) >= 2
    for process in with_ros:
        check_alone(process, *roots)


def server_below(parent: psutil.Process) -> Callable[[], psutil.Process]:
    """The process `roboneuron serve` among those started by a test."""
    return lambda: next(p for p in parent.children(recursive=True) if "serve" in p.cmdline())


@pytest.fixture
def own_node(shell: dict[str, str]) -> Iterator[None]:
    """A node of the sourced ROS, in a process without RoboNeuron."""
    command = in_sourced_shell(
        str(KILTED / "bin" / "python"), str(Path(__file__).with_name("own_node.py"))
    )
    with subprocess.Popen(
        command,
        env={
            **shell,
            "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1",
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        },
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdin is not None
        wait_for_line(process.stdout, "there")
        yield
        process.stdin.close()
        try:
            process.wait(WAIT_S)
        except subprocess.TimeoutExpired:
            process.kill()


async def speak(client: Client) -> None:
    """Publish, read and call types of the workspace, with a node of the sourced ROS."""

    do = Agent(client).do

    message = {"offset": [0.25, 0.0, 0.5], "tool": "tig", "picture": [1, 2, 3]}
    heard = ""
    with anyio.fail_after(WAIT_S):
        while not heard:
            await do("publish_seam", message=message)
            heard = (await do("read_heard", timeout_s=WAIT_S))["messages"][0]["data"]
    assert heard == "tig [0.25, 0.0, 0.5] 3"
    struck = await do("call_strike", request={"seam": {"tool": "mag"}}, timeout_s=WAIT_S)
    assert struck["response"] == {"success": True, "message": "mag"}
    far = await client.call_tool("publish_seam", {"message": {"offset": [0, 0, 9]}})
    assert far.is_error


@pytest.mark.parametrize("installation", ["sourced", "auto"])
def test_server_and_modules_use_the_sourced_ros_and_its_types(
    shell: dict[str, str], own_node: None, tmp_path: Path, installation: str
) -> None:
    config = configuration(tmp_path, installation, OWN_TYPES)
    words = in_sourced_shell(str(SOURCED / "bin" / "roboneuron"), "serve", "--config", str(config))
    server = StdioServerParameters(command=words[0], args=words[1:], env=shell)

    async def scenario() -> None:
        async with Client(server) as client:
            await speak(client)
            started = await client.call_tool("start_robot", {})
            assert not started.is_error, started.content
            await check_processes(server_below(psutil.Process()), ROS, SETUP.parent)

    anyio.run(scenario)


@pytest.mark.parametrize("installation", ["wheels", "sourced"])
def test_types_of_a_node_are_learnt_by_either_ros(
    shell: dict[str, str], own_node: None, tmp_path: Path, installation: str
) -> None:
    """Without the workspace: Jazzy's wheels, or Kilted alone, with a node of Kilted."""
    if installation == "wheels":
        prefix = [str(OWN / "bin" / "roboneuron")]
    else:
        prefix = in_sourced_shell(str(SOURCED / "bin" / "roboneuron"), setup=ROS / "setup.bash")
    environment = {**shell, "XDG_DATA_HOME": str(tmp_path / "data")}
    environment["XDG_CACHE_HOME"] = str(tmp_path / "cache")
    learnt = subprocess.run(
        [*prefix, "ros", "learn", "graph"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert learnt.returncode == 0, learnt.stdout + learnt.stderr
    assert re.search(r"^own_msgs/msg/Seam  RIHS01_", learnt.stdout, re.MULTILINE)
    assert re.search(r"^own_msgs/srv/Strike  RIHS01_", learnt.stdout, re.MULTILINE)
    config = configuration(tmp_path, installation, OWN_TYPES)
    words = [*prefix, "serve", "--config", str(config)]
    server = StdioServerParameters(command=words[0], args=words[1:], env=environment)

    async def scenario() -> None:
        async with Client(server) as client:
            await speak(client)

    anyio.run(scenario)


def test_wheels_are_used_in_the_same_shell_when_they_are_wanted(
    shell: dict[str, str], tmp_path: Path
) -> None:
    config = configuration(tmp_path, "wheels")
    words = in_sourced_shell(str(SOURCED / "bin" / "roboneuron"), "serve", "--config", str(config))
    server = StdioServerParameters(command=words[0], args=words[1:], env=shell)

    async def scenario() -> None:
        async with Client(server) as client:
            started = await client.call_tool("start_robot", {})
            assert not started.is_error, started.content
            await check_processes(server_below(psutil.Process()), SOURCED)

    anyio.run(scenario)


def doctor(shell: dict[str, str], *words: str) -> str:
    """Relevant output of `roboneuron doctor`; its other checks may have any result."""
    ended = subprocess.run(
        words, env=shell, capture_output=True, text=True, timeout=180, check=False
    )
    return ended.stdout + ended.stderr


@pytest.mark.parametrize(
    ("python", "installation", "said"),
    [
        (SOURCED, "auto", rf"rclpy from {ROS}/lib/.*; sourced: ROS kilted of {ROS} is sourced"),
        (SOURCED, "wheels", rf"rclpy from {SOURCED}/lib/.*; wheels: the configuration says"),
    ],
)
def test_doctor_says_which_and_why(
    shell: dict[str, str], tmp_path: Path, python: Path, installation: str, said: str
) -> None:
    config = configuration(tmp_path, installation)
    words = (str(python / "bin" / "roboneuron"), "doctor", "--config", str(config))
    text = doctor(shell, *in_sourced_shell(*words))
    assert re.search(said, text), text
    assert re.search(r"\d+ of \d+ images of 640x480 arrived", text), text


def test_doctor_names_what_is_mixed_and_what_to_type(shell: dict[str, str], tmp_path: Path) -> None:
    """As in a shell with a half-copied setup.bash."""
    shell["LD_LIBRARY_PATH"] = f"{ROS}/lib"
    text = doctor(shell, str(SOURCED / "bin" / "roboneuron"), "doctor")
    assert (
        f"Another ROS would be mixed with that of {SOURCED}: {ROS}/lib by LD_LIBRARY_PATH" in text
    )
    assert "Type: unset LD_LIBRARY_PATH" in text


def test_a_sourced_ros_that_is_not_there_is_missed(shell: dict[str, str], tmp_path: Path) -> None:
    config = configuration(tmp_path, "sourced")
    ended = subprocess.run(
        [str(SOURCED / "bin" / "roboneuron"), "serve", "--config", str(config)],
        env=shell,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert ended.returncode == 2
    assert "no ROS installation is sourced. Type `source /opt/ros/" in ended.stderr


@pytest.mark.parametrize("installation", ["wheels", "sourced"])
@pytest.mark.parametrize("venv", [OWN, SOURCED], ids=lambda path: path.name)
def test_the_demo_runs_in_that_shell(
    shell: dict[str, str], tmp_path: Path, venv: Path, installation: str
) -> None:
    if venv == OWN and installation == "sourced" and _python(OWN) != _python(SOURCED):
        pytest.skip("the sourced ROS is for another Python than .venv's")
    config = tmp_path / "roboneuron.toml"
    shown = [str(venv / "bin" / "roboneuron"), "config", "show"]
    text = subprocess.run(shown, env=shell, capture_output=True, text=True, timeout=60, check=True)
    config.write_text(f'{text.stdout}\n[ros]\ninstallation = "{installation}"\n')
    arguments = f"--config {config} --out {tmp_path / 'out'}"
    made = [f"VENV={venv.name}", f"--old-file={venv.name}/.demo", "demo", f"ARGS={arguments}"]
    ended = subprocess.run(
        in_sourced_shell("make", "-C", str(ROOT), *made),
        env={**shell, "XDG_STATE_HOME": str(tmp_path / "state")},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout[-3000:] + ended.stderr[-3000:]
    assert (tmp_path / "out" / "film.gif").is_file()


def _python(venv: Path) -> str:
    return (venv / "pyvenv.cfg").read_text().split("version = ")[1].split(".")[1]
