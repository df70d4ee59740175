"""An installed distribution as seen by the package rules: metadata, source files, and a probe in a
fresh interpreter.
"""

from __future__ import annotations

import ast
import functools
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.machinery import PathFinder
from importlib.metadata import Distribution, EntryPoint, distributions, entry_points
from pathlib import Path
from types import ModuleType

import roboneuron.command
import roboneuron.feature
from rn_testing.cases import PackageCase
from rn_testing.rule import Violation

PROJECT = "roboneuron"
"""Name of the core's package, and of the entry point group."""
LISTS: Mapping[str, ModuleType] = {
    "roboneuron.feature": roboneuron.feature,
    "roboneuron.command": roboneuron.command,
}
"""Modules that list the names of the core that a kind of plugin may use in addition to
`roboneuron`.
"""
PROBE_LIMIT_S = 60.0
"""Time limit for starting a fresh interpreter and importing a module."""

_PROBE = """
import importlib, io, json, sys, threading, time
import roboneuron.plugins.hookspecs, roboneuron.plugins.specs
sys.path[:0] = json.loads(sys.argv[1])
before, out, threads, effects = set(sys.modules), sys.stdout, threading.active_count(), []
WATCHED = {"socket.connect", "socket.bind", "subprocess.Popen", "os.system", "os.mkdir", "os.remove", "os.rename"}
def audit(event, arguments):
    if event in WATCHED and not (event.startswith("os.") and "__pycache__" in str(arguments)):
        effects.append(f"{event} {arguments[0]}" if arguments else event)
    elif event == "open" and isinstance(arguments[1], str) and set(arguments[1]) & set("wax+"):
        if "__pycache__" not in str(arguments[0]):
            effects.append(f"writes {arguments[0]}")
sys.addaudithook(audit)
sys.stdout = io.StringIO()
begun_s = time.thread_time()
module = importlib.import_module(sys.argv[2])
spent_s = time.thread_time() - begun_s
effects = list(effects)
if sys.stdout.getvalue(): effects.append(f"prints {sys.stdout.getvalue()!r:.40}")
if threading.active_count() > threads: effects.append("starts threads")
if spent_s > 1.0: effects.append(f"computes for {spent_s:.1f} s")
sys.stdout = out
loaded = sorted(set(sys.modules) - before)
from roboneuron.plugins.discovery import discover, read_module
from roboneuron.plugins.hookspecs import HOOKS, extended
try:
    installed = [offer.spec for offer in discover().all_offers]
    read_module(module, extended(HOOKS, installed))
    problem = ""
except Exception as error:
    problem = str(error)
print("\\n" + json.dumps({"loaded": loaded, "problem": problem, "effects": effects}))
"""  # noqa: E501


@dataclass(frozen=True, kw_only=True, slots=True)
class Probe:
    """Result of importing a plugin module in a fresh interpreter.

    Attributes:
        loaded: names of modules loaded by the import, except those loaded by the markers and
            descriptors.
        problem: reason why the module's hooks cannot be used; empty if they can.
        effects: other effects of the import, as parts of a sentence.
    """

    loaded: frozenset[str]
    problem: str
    effects: tuple[str, ...]


def normalise(name: str) -> str:
    """Normalise a project name according to PEP 503."""
    return re.sub(r"[-_.]+", "-", name).lower()


def find_distribution(case: PackageCase) -> Distribution:
    """Metadata of a case's distribution. Raises Violation if it is not installed."""
    # looked up by name, because reading the metadata of every distribution took most of the rules'
    # time
    for found in distributions(name=case.distribution, path=list(case.path or sys.path)):
        if normalise(found.name) == normalise(case.distribution):
            return found
    raise Violation(f"{case.distribution} is not installed")


def header(case: PackageCase, name: str) -> str:
    """A field of the metadata; empty if missing."""
    metadata = find_distribution(case).metadata
    return str(metadata[name]).strip() if name in metadata else ""


def _all_entry_points(case: PackageCase) -> list[EntryPoint]:
    return [p for p in find_distribution(case).entry_points if p.group == PROJECT]


def find_entry_points(case: PackageCase) -> list[EntryPoint]:
    """Entry points of the group `roboneuron` that the case tests. Raises Violation if there are
    none.
    """
    points = [p for p in _all_entry_points(case) if case.plugin in ("", p.name)]
    if not points:
        named = f" {case.plugin!r}" if case.plugin else ""
        raise Violation(f"{case.distribution} has no entry point{named} in the group {PROJECT!r}")
    return points


def find_package(case: PackageCase, module: str) -> str:
    """Name of the plugin's package: the top-level package, or in a distribution with several
    plugins that of `module`.
    """
    is_alone = len(_all_entry_points(case)) == 1
    return (
        module.partition(".")[0]
        if is_alone or not case.plugin
        else module.rpartition(".")[0] or module
    )


def plugin_package(module: str) -> str:
    """Package of the installed plugin that contains `module`; its top-level package if that has at
    most one plugin.
    """
    top = module.partition(".")[0]
    packages = [
        p.module.rpartition(".")[0]
        for p in entry_points(group=PROJECT)
        if p.module.partition(".")[0] == top
    ]
    around = [package for package in packages if f"{module}.".startswith(f"{package}.")]
    return max(around, key=len, default=top) if len(packages) > 1 else top


def find_package_directory(case: PackageCase, module: str) -> Path:
    """Directory of the top-level package of `module`, found without importing it."""
    top = module.partition(".")[0]
    spec = PathFinder.find_spec(top, list(case.path) or None)
    if spec is None or not spec.submodule_search_locations:
        raise Violation(f"there is no package {top!r} for the entry point's module {module!r}")
    return Path(next(iter(spec.submodule_search_locations)))


def source_files(case: PackageCase) -> Iterator[Path]:
    """Python files of the packages named by the entry points, without those of other plugins inside
    them.
    """
    places = {find_package(case, p.module): _place(case, p.module) for p in find_entry_points(case)}
    others = [
        _place(case, p.module) for p in _all_entry_points(case) if case.plugin not in ("", p.name)
    ]
    for directory in set(places.values()):
        inner = [
            other for other in others if other != directory and other.is_relative_to(directory)
        ]
        for path in sorted(directory.rglob("*.py")):
            if not any(path.is_relative_to(other) for other in inner):
                yield path


def _place(case: PackageCase, module: str) -> Path:
    """Directory of the plugin's package."""
    return find_package_directory(case, module).joinpath(*find_package(case, module).split(".")[1:])


def hosted_directories(case: PackageCase) -> Iterator[Path]:
    """Subpackages loaded by other programs than RoboNeuron, through their own entry point
    groups.
    """
    for point in find_distribution(case).entry_points:
        inner = point.module.split(".")[1:-1]
        if point.group not in (PROJECT, "console_scripts") and inner:
            yield find_package_directory(case, point.module).joinpath(*inner)


def imported_modules(path: Path) -> tuple[tuple[str, int], ...]:
    """Absolute names of all modules imported in a file, with line numbers; for modules in `LISTS`
    also the names that it uses.
    """
    status = path.stat()
    return _imported_modules(path, status.st_mtime_ns, status.st_size)


@functools.lru_cache(maxsize=1024)
def _imported_modules(path: Path, changed_ns: int, size: int) -> tuple[tuple[str, int], ...]:
    """Imports of one version of a file; cached, because four rules use them."""
    return tuple(_imports(ast.parse(path.read_text(encoding="utf-8"), filename=str(path))))


def _imports(tree: ast.Module) -> Iterator[tuple[str, int]]:
    nodes = tuple(ast.walk(tree))
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield from ((f"{node.module}.{alias.name}", node.lineno) for alias in node.names)
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if name in ("import_module", "__import__") and isinstance(node.args[0].value, str):
                yield node.args[0].value, node.lineno
    yield from _uses_of_groups(nodes)


def _uses_of_groups(nodes: Sequence[ast.AST]) -> Iterator[tuple[str, int]]:
    groups = {
        alias.asname or alias.name: f"{node.module}.{alias.name}"
        for node in nodes
        if isinstance(node, ast.ImportFrom) and node.module is not None and node.module in LISTS
        for alias in node.names
        if alias.name in LISTS[node.module].GROUPS
    }
    for node in nodes if groups else ():
        match node:
            case ast.Attribute(value=ast.Name(id=name), attr=used) if name in groups:
                yield f"{groups[name]}.{used}", node.lineno


def requirements(case: PackageCase) -> frozenset[str]:
    """Normalised names of the declared requirements, including those of extras."""
    lines = find_distribution(case).requires or []
    return frozenset(
        normalise(re.split(r"[^A-Za-z0-9._-]", line.strip(), maxsplit=1)[0]) for line in lines
    )


def _import_path() -> list[str]:
    """The import path of this process without the working directory, which `python -m` adds.

    A stray file such as re.py there is not the plugin's fault.
    """
    asked = [
        Path(entry).absolute()
        for entry in os.environ.get("PYTHONPATH", "").split(os.pathsep)
        if entry
    ]
    here = Path.cwd()
    return [entry for entry in sys.path if entry and (Path(entry) != here or here in asked)]


@functools.lru_cache(maxsize=16)
def probe(case: PackageCase, module: str) -> Probe:
    """Import `module` in a fresh interpreter, once per case. Raises Violation if that fails."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(_import_path()),
        "PYTHONSAFEPATH": "1",
    }
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-B", "-c", _PROBE, json.dumps(list(case.path)), module],
            capture_output=True,
            text=True,
            timeout=PROBE_LIMIT_S,
            env=environment,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise Violation(f"importing {module} took longer than {PROBE_LIMIT_S:g} s") from error
    if done.returncode != 0:
        last = done.stderr.strip().splitlines()[-1:] or [f"exit status {done.returncode}"]
        raise Violation(f"importing {module} failed: {last[0]}")
    answer = json.loads(done.stdout.strip().splitlines()[-1])
    return Probe(
        loaded=frozenset(answer["loaded"]),
        problem=answer["problem"],
        effects=tuple(answer["effects"]),
    )
