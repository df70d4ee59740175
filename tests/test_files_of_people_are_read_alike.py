"""Each reader of a file that a person writes ends at once, with one error that says what is wrong,
whatever has the file's name.
"""

from __future__ import annotations

import os
import threading
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path

import pytest

from rn_recorder_bags.mapping import read_mapping
from rn_standard.console.chosen_plugins import read_disabled
from rn_standard.demo.run import DemoOptions, write_configuration
from rn_standard.http.options import TokenConfig
from rn_standard.http.tokens import read_tokens
from roboneuron import ConfigurationError
from roboneuron.cli.state_folder import folders_of
from roboneuron.config import reading

TEXT = '[robot]\nname = "none"\n'
TOKEN = "a-token-of-sufficient-length"
END_S = 5.0
Read = Callable[[Path], object]


def demo(path: Path) -> object:
    options = DemoOptions(
        instruction="", seed=None, gui=False, max_s=1.0, output=path.parent, config=path
    )
    return write_configuration(options, path.parent)


def token(path: Path) -> object:
    return read_tokens((TokenConfig(name="lab", role="viewer", file=str(path)),), {})


TOML: dict[str, Read] = {
    "serve": reading.load_config,
    "the state directory": reading.read_state_directory,
    "estop": lambda path: folders_of(Namespace(config=path, state=path.parent)),
    "plugins": read_disabled,
    "demo": demo,
}
READERS = {**TOML, "token": token}
OTHER_KEYS: dict[str, Read] = {"runs import": read_mapping}
"""Readers of other tables than those of a roboneuron.toml."""


def pipe(path: Path) -> None:
    os.mkfifo(path, 0o600)


def loop(path: Path) -> None:
    path.symlink_to(path)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def large(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 40)
    path.chmod(0o600)


def of_bytes(data: bytes) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        path.write_bytes(data)
        path.chmod(0o600)

    return write


ODD = {
    "a pipe": pipe,
    "a folder": lambda path: path.mkdir(mode=0o700),
    "a link to itself": loop,
    "a device": device,
    "a large file": large,
    "Latin-1": of_bytes("# K\xf6rper".encode("latin-1")),
    "UTF-16": of_bytes(TEXT.encode("utf-16")),
    "missing": lambda path: None,
}
NO_TABLES = {
    "nested deeply": "a = " + "[" * 5000 + "]" * 5000,
    "nested": "a = " + "[" * 40 + "]" * 40,
    "infinite": f"{TEXT}[plugins.urdf]\nmax_translation_m = inf\n",
    "no number": f"{TEXT}[plugins.urdf]\nmax_translation_m = nan\n",
    "digits": f"{TEXT}[plugins.urdf]\nmax_translation_m = {'9' * 5000}\n",
}


def ended(read: Read, path: Path) -> object:
    """What a reader returns or raises, on a thread of its own."""
    found: list[object] = []

    def run() -> None:
        try:
            found.append(read(path))
        except BaseException as error:
            found.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(END_S)
    assert found, f"still reading after {END_S:g} s"
    return found[0]


@pytest.mark.parametrize("name", ODD)
@pytest.mark.parametrize("reader", READERS | OTHER_KEYS)
def test_what_is_no_text_is_refused_at_once(reader: str, name: str, tmp_path: Path) -> None:
    path = tmp_path / "file.toml"
    ODD[name](path)
    error = ended((READERS | OTHER_KEYS)[reader], path)
    assert isinstance(error, ConfigurationError)
    assert path.name in str(error)


@pytest.mark.parametrize("name", NO_TABLES)
@pytest.mark.parametrize("reader", TOML | OTHER_KEYS)
def test_what_is_no_table_is_refused(reader: str, name: str, tmp_path: Path) -> None:
    path = tmp_path / "file.toml"
    path.write_text(NO_TABLES[name], encoding="utf-8")
    error = ended((TOML | OTHER_KEYS)[reader], path)
    assert isinstance(error, ConfigurationError)
    assert path.name in str(error)


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"], ids=["plain", "with a mark"])
@pytest.mark.parametrize("reader", READERS)
def test_an_editor_may_put_its_mark_and_line_ends(reader: str, mark: bytes, tmp_path: Path) -> None:
    """Editors of another system write a byte order mark, and \\r\\n."""
    path = tmp_path / "file.toml"
    text = TOKEN if reader == "token" else TEXT
    path.write_bytes(mark + text.replace("\n", "\r\n").encode())
    path.chmod(0o600)
    found = ended(READERS[reader], path)
    assert not isinstance(found, BaseException), found
