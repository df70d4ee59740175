"""The command `roboneuron plugins new`: creates a plugin package of a kind from templates."""

from __future__ import annotations

import keyword
import re
from argparse import ArgumentParser, Namespace
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from string import Template

from rn_standard.declared_arm.arm_draft import ArmDraft, draft_arm
from rn_standard.declared_arm.real_drivers import REAL_DRIVERS
from rn_standard.declared_arm.urdf_guesses import NO_GRIPPER, Chosen
from rn_testing.new_arm import words_of
from roboneuron import ConfigurationError
from roboneuron.command import PLUGIN_KINDS, descriptor

BROUGHT = {
    "monitor": "rn-standard",
    "suite": "rn-eval",
    "teleoperator": "rn-standard",
}
"""Kinds whose hook is provided by another package, with that package."""
NEW_KINDS = sorted([*PLUGIN_KINDS, *BROUGHT])
"""Kinds with templates."""
PREFIXES = {kind: "accel" if kind == "acceleration" else kind for kind in NEW_KINDS}
"""Middle part of the distribution's name: rn-<prefix>-<name>."""


class New:
    """Write a plugin package of one of the kinds; it passes its own contract tests as written."""

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron plugins new`."""
        parser.add_argument(
            "kind", choices=NEW_KINDS, metavar="KIND", help=f"one of {', '.join(NEW_KINDS)}"
        )
        parser.add_argument(
            "name", metavar="NAME", help="name by which users select it, such as my-policy"
        )
        parser.add_argument(
            "--out", type=Path, metavar="DIR", help="directory to create (./rn-KIND-NAME)"
        )
        _add_arm_arguments(parser)

    def run(self, arguments: Namespace) -> int:
        """Write the package and print the next steps."""
        kind, name = arguments.kind, arguments.name
        distribution = f"rn-{PREFIXES[kind]}-{name}"
        directory = arguments.out or Path(distribution)
        arm = _read_arm(arguments, directory)
        driver = None if arguments.driver == "none" else arguments.driver
        written = write_package(kind, name, directory, arm, driver)
        if arm is not None:
            print(*arm.report(), sep="\n")
        print(f"Wrote {len(written)} files of {distribution} to {directory}/. Next:\n")
        print(
            f"  cd {directory}\n  pip install -e '.[testing]'\n  pytest\n  roboneuron plugins "
            f"check {name}"
        )
        if arm is not None:
            print("  roboneuron config check roboneuron.toml\n\nThen follow FIRST_MOTION.md.")
        return 0


def _add_arm_arguments(parser: ArgumentParser) -> None:
    arm = parser.add_argument_group("robot", "an arm from its description; guesses are printed")
    arm.add_argument("--urdf", type=Path, metavar="FILE", help="URDF, or the output of xacro")
    arm.add_argument(
        "--driver",
        choices=["none", *REAL_DRIVERS],
        help="what moves the real arm; none: it is simulated only",
    )
    arm.add_argument("--base", metavar="LINK", help="link in whose frame poses are")
    arm.add_argument("--tcp", metavar="LINK", help="link whose z axis points out of the tool")
    arm.add_argument("--joints", nargs="+", metavar="JOINT", help="joints of the arm")
    arm.add_argument("--gripper", metavar="JOINT", help=f"joint of the gripper, or {NO_GRIPPER}")
    arm.add_argument(
        "--package-path",
        type=Path,
        action="append",
        metavar="DIR",
        help="folder with the ROS packages of the meshes; may be given several times",
    )


def _read_arm(arguments: Namespace, directory: Path) -> ArmDraft | None:
    """The arm of `--urdf`; None without one. Raises ConfigurationError."""
    options = ("driver", "base", "tcp", "joints", "gripper", "package_path")
    if arguments.urdf is None:
        given = next((name for name in options if getattr(arguments, name) is not None), None)
        if given is not None:
            raise ConfigurationError(f"--{given.replace('_', '-')} needs --urdf FILE.")
        return None
    if arguments.kind != "robot":
        raise ConfigurationError(f"--urdf is for robots, not for a new {arguments.kind}.")
    _check_writable(arguments.name, directory)
    return draft_arm(
        arguments.name,
        arguments.urdf,
        chosen=Chosen(
            base=arguments.base,
            tcp=arguments.tcp,
            joints=tuple(arguments.joints or ()),
            gripper=arguments.gripper,
        ),
        package_paths=arguments.package_path or (),
        driver=arguments.driver or "",
    )


def write_package(
    kind: str,
    name: str,
    directory: Path,
    arm: ArmDraft | None = None,
    driver: str | None = None,
) -> list[Path]:
    """Write a plugin package and return the paths of its files; a robot of a description if `arm`
    is given, with a driver of `REAL_DRIVERS` or None.

    Raises:
        ConfigurationError: the name is malformed, the directory is not empty, or a mesh cannot be
            copied.
    """
    _check_writable(name, directory)
    package = f"rn_{PREFIXES[kind]}_{name}".replace("-", "_")
    words = {
        "kind": kind,
        "name": name,
        "distribution": f"rn-{PREFIXES[kind]}-{name}",
        "package": package,
    }
    words |= {"cls": _class_name(name), "tool": name.replace("-", "_")}
    needed = ["roboneuron-core", *([BROUGHT[kind]] if kind in BROUGHT else [])]
    folders = ["common", kind]
    if arm is not None:
        needed.append("rn-simulation")
        words |= words_of(arm, name, driver)
        folders[1] = "arm"
    words["dependencies"] = ", ".join(f'"{other}>=0.1,<0.2"' for other in needed)
    templates = files("rn_testing") / "templates"
    written = [_write(directory / "src" / package / "py.typed", "")]
    sources = [source for folder in folders for source in (templates / folder).iterdir()]
    if arm is not None:
        sources.append(templates / kind / "test_contract.py.tmpl")
        inside = directory / "src" / package
        written.append(_write(inside / f"{name}.urdf", arm.shapes.urdf))
        written += arm.shapes.copy_to(inside)
    for source in sorted(sources, key=lambda source: source.name):
        written.append(_write(directory / _place(source.name, package), _fill(source, words)))
    return written


def _class_name(name: str) -> str:
    return "".join(part.capitalize() for part in name.split("-"))


def _check_writable(name: str, directory: Path) -> None:
    """Raise ConfigurationError for a malformed name or a directory that is not empty."""
    class_name = _class_name(name)
    if (
        not descriptor.NAME_PATTERN.fullmatch(name)
        or not class_name.isidentifier()
        or keyword.iskeyword(class_name)
    ):
        suggestion = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-0123456789")
        raise ConfigurationError(
            f"The name {name!r} is malformed, expected lower-case letters, digits and single "
            "hyphens, a letter first"
            f"{f'; for instance {suggestion!r}' if suggestion else ''}."
        )
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise ConfigurationError(
            f"{directory} exists and is not empty.", hint="Choose another one with --out."
        )


def _place(template: str, package: str) -> Path:
    """Destination of a template: metadata at the top, tests in `tests`, everything else in the
    package.
    """
    name = template.removesuffix(".tmpl")
    if name in ("pyproject.toml", "README.md", "LICENSE", "roboneuron.toml", "FIRST_MOTION.md"):
        return Path(name)
    if name.startswith("test_"):
        return Path("tests") / name.replace("test_contract", f"test_{package}_keeps_its_contract")
    return Path("src") / package / name


def _fill(source: Traversable, words: dict[str, str]) -> str:
    text = source.read_text(encoding="utf-8")
    return Template(text).substitute(words) if source.name.endswith(".tmpl") else text


def _write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path
