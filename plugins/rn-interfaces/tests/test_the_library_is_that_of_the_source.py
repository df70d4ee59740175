"""The library of native.c: compiled from the source that is there, loaded only where nobody else
could have written it, and part of each wheel.
"""

from __future__ import annotations

import ctypes
import os
import platform
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from rn_interfaces import library, native
from rn_interfaces.library import LibraryError, cached_library, find_library
from rn_interfaces.structures import LayoutError

PACKAGE = Path(__file__).parents[1]
NONE = Path("no library is shipped here")
PROBE = """
from rn_interfaces import library, native
native.check()
print(library.find_library())
"""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's cache, still empty."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def write_source(path: Path, number: int) -> Path:
    """C with a function that returns the number."""
    path.write_text(
        f'__attribute__((visibility("default"))) int answer(void) {{ return {number}; }}'
    )
    return path


def answer(path: Path) -> int:
    """What that function returns."""
    found: int = ctypes.CDLL(str(path)).answer()
    return found


def test_another_source_or_processor_has_another_library(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "native.c"
    first = find_library(write_source(source, 1), NONE)
    second = find_library(write_source(source, 2), NONE)
    assert (answer(first), answer(second)) == (1, 2)
    assert find_library(write_source(source, 1), NONE) == first
    monkeypatch.setattr(platform, "machine", lambda: "riscv64")
    assert cached_library(source) != first


def test_a_library_is_compiled_once_and_closed_to_others(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (cache / "roboneuron").mkdir(mode=0o755, parents=True)
    place = find_library(shipped=NONE)
    assert place.parent == cache / "roboneuron"
    assert [path.stat().st_mode & 0o777 for path in (place.parent, place)] == [0o700, 0o700]
    assert list(place.parent.iterdir()) == [place]
    monkeypatch.setattr(shutil, "which", lambda _: None)
    assert find_library(shipped=NONE) == place


@pytest.mark.parametrize("mode", [0o720, 0o702])
def test_a_library_that_others_may_write_is_not_loaded(cache: Path, mode: int) -> None:
    place = find_library(shipped=NONE)
    place.chmod(mode)
    with pytest.raises(LibraryError, match=r"others may write it\. Delete it"):
        find_library(shipped=NONE)


def test_a_link_in_the_cache_is_not_loaded(cache: Path, tmp_path: Path) -> None:
    place = find_library(shipped=NONE)
    place.rename(tmp_path / "elsewhere.so")
    place.symlink_to(tmp_path / "elsewhere.so")
    with pytest.raises(LibraryError, match="is not loaded"):
        find_library(shipped=NONE)


@pytest.mark.parametrize("owned", ["file", "folder"])
def test_what_another_user_owns_is_not_loaded(
    cache: Path, owned: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = find_library(shipped=NONE)
    theirs = place if owned == "file" else place.parent
    own = os.geteuid()
    if own == 0:
        os.chown(theirs, 12345, -1)
    else:  # only root gives a file away: this user becomes another one, for what is looked at
        stat = "lstat" if owned == "file" else "stat"
        real = getattr(Path, stat)

        def given_away(path: Path, **words: bool) -> os.stat_result:
            facts = list(real(path, **words))
            facts[4] = own + 1 if path == theirs else facts[4]
            return os.stat_result(facts)

        monkeypatch.setattr(Path, stat, given_away)
    with pytest.raises(LibraryError, match=f"^{theirs} is not loaded, because it belongs"):
        find_library(shipped=NONE)


def test_without_compiler_and_library_one_sentence_says_what_to_type(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    with pytest.raises(LayoutError, match=r"no C compiler \(cc\).*`apt-get install gcc`.*a wheel"):
        native.entries.__wrapped__()


def test_a_source_that_does_not_compile_leaves_no_library(cache: Path, tmp_path: Path) -> None:
    source = tmp_path / "native.c"
    source.write_text("int answer(void) { int unused; return 1; }")
    with pytest.raises(LibraryError, match=r"does not compile .*native\.c: (.|\n)*unused"):
        find_library(source, NONE)
    assert list((cache / "roboneuron").iterdir()) == []


def test_a_cache_that_cannot_be_written_is_told(tmp_path: Path, cache: Path) -> None:
    cache.write_text("a file")
    with pytest.raises(LibraryError, match="Set XDG_CACHE_HOME to a folder of yours"):
        find_library(shipped=NONE)


def test_a_library_that_cannot_be_loaded_is_no_reason_to_compile(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = tmp_path / "_native.so"
    shipped.write_text("of another processor")
    monkeypatch.setattr(native, "find_library", lambda: find_library(shipped=shipped))
    with pytest.raises(LayoutError, match=r"_native\.so"):
        native.entries.__wrapped__()
    assert not cache.exists()


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="manylinux is of glibc")
def test_a_library_that_needs_a_newer_glibc_is_not_called_manylinux(tmp_path: Path) -> None:
    made = tmp_path / "native.so"
    made.write_bytes(b"\0GLIBC_2.2.5\0GLIBC_2.17\0")
    assert library.wheel_platform(made) == f"manylinux_2_17_{platform.machine()}"
    made.write_bytes(b"\0GLIBC_2.34\0")
    assert library.wheel_platform(made) == f"linux_{platform.machine()}"


def build(out: Path, path: str | None = None) -> subprocess.CompletedProcess[str]:
    """Build the wheel, with another PATH where one is given."""
    return subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out)],
        cwd=PACKAGE,
        env={**os.environ, **({} if path is None else {"PATH": path})},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.mark.release
def test_a_wheel_holds_the_library_and_works_without_a_compiler(
    cache: Path, tmp_path: Path
) -> None:
    pytest.importorskip("hatchling", reason="wheels are built with hatchling")
    done = build(tmp_path / "out")
    assert done.returncode == 0, done.stderr
    (built,) = (tmp_path / "out").glob("*.whl")
    assert built.name.endswith(f"-py3-none-manylinux_2_17_{platform.machine()}.whl")
    site = tmp_path / "site"
    with zipfile.ZipFile(built) as archive:
        archive.extractall(site)
    (wheel,) = site.glob("*.dist-info/WHEEL")
    assert "Root-Is-Purelib: false" in wheel.read_text()
    assert (site / "rn_interfaces" / "native.c").read_bytes() == library.SOURCE.read_bytes()
    probed = subprocess.run(
        [sys.executable, "-c", PROBE],
        env={**os.environ, "PYTHONPATH": str(site), "PATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert probed.returncode == 0, probed.stderr
    assert probed.stdout.strip() == str(site / "rn_interfaces" / "_native.so")
    assert not cache.exists()


@pytest.mark.release
def test_a_wheel_is_not_built_without_a_compiler(tmp_path: Path) -> None:
    pytest.importorskip("hatchling", reason="wheels are built with hatchling")
    done = build(tmp_path / "out", path=str(tmp_path))
    assert done.returncode != 0
    assert done.stderr.strip().startswith("rn-interfaces: There is no C compiler (cc)")
    assert len(done.stderr.strip().splitlines()) == 1
    assert not list((tmp_path / "out").glob("*.whl"))
