"""Python classes, descriptions and hashes of a package's interfaces, by rosidl's own generators.

    python -m rn_interfaces.generate FOLDER < NAMES

To be run as a separate program: the generators print and change global state. Nothing is compiled:
the type supports are created at run time (`rn_interfaces.support`).
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import redirect_stdout
from importlib.metadata import distribution
from pathlib import Path

_WORDS = "from math import inf, nan\n"
_USES_WORDS = re.compile(r"^ +(?:return|'\w+':) (?:nan|inf),?$", re.MULTILINE)
FORM = "with inf and nan"
"""Form of the classes, which changes with this program."""


class GenerationError(RuntimeError):
    """The generators refuse a definition."""


def templates() -> Path:
    """The folder of the templates of rosidl_generator_py, as its wheel has it.

    Raises
    ------
    GenerationError
        There is none.
    """
    name = "share/rosidl_generator_py/resource/_idl.py.em"
    found = Path(str(distribution("ros-rosidl-generator-py").locate_file(""))).parents
    for prefix in (Path(sys.prefix), *found):
        if (prefix / name).is_file():
            return (prefix / name).parent
    raise GenerationError(f"no {name} in {sys.prefix}; reinstall ros-rosidl-generator-py")


def describe(
    package: str, names: Sequence[str], texts: Path, work: Path, includes: Mapping[str, Path]
) -> None:
    """Write `work/<package>/<kind>/<Name>.idl` and `.json`, the description with all hashes.

    Parameters
    ----------
    names
        Such as `msg/Seam`.
    texts
        The folder that holds `<package>/msg/Seam.msg`.
    includes
        Folders that hold `<kind>/<Name>.json`, by package; of packages without one, and of the
        interfaces of this one that are not among `names`, they are in `work`.
    """
    import rosidl_generator_type_description as description  # type: ignore[import-untyped]
    from rosidl_adapter import convert_to_idl  # type: ignore[import-untyped]

    output = work / package
    for name in names:
        path = Path(f"{name}.{name.partition('/')[0]}")
        (output / path.parent).mkdir(parents=True, exist_ok=True)
        convert_to_idl(texts / package, package, path, output)
    description.generate_type_hash(str(_arguments(package, names, work, includes)))


def write_class(package: str, name: str, work: Path) -> None:
    """Write `work/<package>/<kind>/_<name>.py` from the IDL written by `describe`.

    rosidl writes the defaults `nan` and `inf` as these words, which the file therefore imports.
    """
    from rosidl_pycommon import generate_files  # type: ignore[import-untyped]

    arguments = str(_arguments(package, [name], work, {}))
    for path in map(Path, generate_files(arguments, {"_idl.py.em": "_%s.py"})):
        text = path.read_text(encoding="utf-8")
        if _USES_WORDS.search(text):
            path.write_text(f"{_WORDS}{text}", encoding="utf-8")


def _arguments(
    package: str, names: Iterable[str], work: Path, includes: Mapping[str, Path]
) -> Path:
    output = work / package
    others = {path.name: path for path in work.iterdir() if path.is_dir() and path != output}
    listed = [f"{name}.idl" for name in names]
    facts = {
        "package_name": package,
        "output_dir": str(output),
        "template_dir": str(templates()),
        "idl_tuples": [f"{output}:{name}" for name in listed],
        "ros_interface_dependencies": [],
        "ros_interface_files": [],
        "target_dependencies": [],
        "include_paths": [f"{name}:{path}" for name, path in {**includes, **others}.items()],
        "type_description_tuples": [
            f"{name}:{(output / name).with_suffix('.json')}" for name in listed
        ],
    }
    arguments = output / "arguments.json"
    arguments.write_text(json.dumps(facts), encoding="utf-8")
    return arguments


def main() -> None:
    """Write the classes of interfaces whose IDL is in the folder given as the argument; their full
    names are the lines of stdin. The result is [name, reason] as a line of JSON for each, with an
    empty reason for success. It ends after a failure, because the generators do not recover.
    """
    work = Path(sys.argv[1])
    with redirect_stdout(sys.stderr):
        for line in sys.stdin.read().split():
            package, _, name = line.partition("/")
            reason = ""
            try:
                write_class(package, name, work)
            except Exception as error:  # of lark, empy and the generators, without a common base
                reason = f"{type(error).__name__}: {' '.join(str(error).split())}"[:200]
            print(json.dumps([line, reason]), file=sys.__stdout__, flush=True)
            if reason:
                return


if __name__ == "__main__":
    main()
