"""Without rn-link: the commands of docs/two-machines.md make an authority, a certificate of the
server and a token, with which a robot is admitted.
"""

from __future__ import annotations

import re
import subprocess
import tomllib
from pathlib import Path

import pytest
from policy_servers import Robot, Serve, answers

from roboneuron import ConfigurationError, NotReadyError

pytestmark = [pytest.mark.timeout(200), pytest.mark.exhaustive]
PAGE = (Path(__file__).parents[3] / "docs" / "two-machines.md").read_text(encoding="utf-8")


def make(folder: Path, address: str) -> None:
    """Type the commands of the page in a folder, for a server of that address."""
    folder.mkdir(exist_ok=True)
    (block,) = re.findall(r"```bash\n(openssl.*?)```", PAGE, re.DOTALL)
    typed = block.replace("192.168.1.20", address)
    subprocess.run(["bash", "-ec", typed], cwd=folder, check=True, capture_output=True)


def test_a_robot_trusts_a_server_of_its_own_authority_and_no_other(
    serve: Serve, robot: Robot, tmp_path: Path
) -> None:
    for name, address in (("keys", "127.0.0.1"), ("others", "127.0.0.1"), ("named", "10.0.0.1")):
        make(tmp_path / name, address)
    keys = tmp_path / "keys"
    listen, theirs = (
        tomllib.loads(text)
        for text in re.findall(r"```toml\n([^`]*?robots\.token.*?)```", PAGE, re.DOTALL)
    )
    server = serve(**in_folder(listen["listen"], keys))
    options = theirs["hosts"]["gpu"]["options"]
    assert answers(robot(server.address, **in_folder(options, keys)))
    for name, told in (("ca_file", "not trusted"), ("token_file", "HTTP 401")):
        mixed = in_folder(options, keys) | in_folder({name: options[name]}, tmp_path / "others")
        with pytest.raises(ConfigurationError, match=told):
            robot(server.address, **mixed)
    of_another_name = serve(**in_folder(listen["listen"], tmp_path / "named"))
    with pytest.raises(ConfigurationError, match="not trusted"):
        robot(of_another_name.address, **in_folder(options, tmp_path / "named"))
    clear = {"token_file": str(keys / "robots.token"), "start_timeout_s": 0.5}
    with pytest.raises(NotReadyError, match="closed the connection without an answer"):
        robot(server.address, **clear)


def in_folder(options: dict[str, str], folder: Path) -> dict[str, str]:
    """Options with paths of the files that are in the folder."""
    paths = {name: folder / value for name, value in options.items()}
    return {name: str(paths[name]) if paths[name].exists() else options[name] for name in options}
