"""Python classes, descriptions and hashes of a package's interfaces, by rosidl's own generators.

    python -m rn_interfaces.generate PACKAGE TEXTS OUTPUT INCLUDE...

Run as a program: the generators print, change global state and read the file system. Nothing is
compiled: the type supports are made at run time (`rn_interfaces.support`).
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable
from contextlib import redirect_stdout
from pathlib import Path

KINDS = ("msg", "srv", "action")


def generate(package: str, names: Iterable[str], texts: Path, output: Path, prefixes: Iterable[Path]) -> None:
    """Write `output/<kind>/_<name>.py` and `output/<kind>/<Name>.json` of some interfaces.

    `names` are such as `msg/Seam`; `texts` is the folder that holds `msg/Seam.msg`; `prefixes` are
    folders that hold `<package>/<kind>/<Name>.json` of other packages.
    """
    import rosidl_generator_py  # type: ignore[import-untyped]
    import rosidl_generator_type_description as describe  # type: ignore[import-untyped]
    from rosidl_adapter import convert_to_idl  # type: ignore[import-untyped]
    from rosidl_pycommon import generate_files  # type: ignore[import-untyped]

    templates = Path(rosidl_generator_py.__file__).parents[4] / "share/rosidl_generator_py/resource"
    relative = []
    for name in names:
        path = Path(f"{name}.{name.partition('/')[0]}")
        (output / path.parent).mkdir(parents=True, exist_ok=True)
        convert_to_idl(texts, package, path, output)
        relative.append(path.with_suffix(".idl").as_posix())
    others = {folder.name: folder for prefix in prefixes for folder in prefix.iterdir()}
    others.pop(package, None)
    arguments = output / "arguments.json"
    facts = {
        "package_name": package,
        "output_dir": str(output),
        "template_dir": str(templates),
        "idl_tuples": [f"{output}:{name}" for name in relative],
        "ros_interface_dependencies": [],
        "ros_interface_files": [],
        "target_dependencies": [],
        "include_paths": [f"{name}:{folder}" for name, folder in others.items()],
    }
    arguments.write_text(json.dumps(facts), encoding="utf-8")
    describe.generate_type_hash(str(arguments))
    facts["type_description_tuples"] = [
        f"{name}:{(output / name).with_suffix('.json')}" for name in relative
    ]
    arguments.write_text(json.dumps(facts), encoding="utf-8")
    generate_files(str(arguments), {"_idl.py.em": "_%s.py"})


def main() -> None:
    package, texts, output, prefixes, *names = sys.argv[1:]
    with redirect_stdout(sys.stderr):
        generate(
            package,
            names,
            Path(texts),
            Path(output),
            [Path(one) for one in prefixes.split(os.pathsep)],
        )


if __name__ == "__main__":
    main()
