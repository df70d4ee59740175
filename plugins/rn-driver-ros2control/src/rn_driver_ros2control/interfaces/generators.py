"""Run the rosidl generators of the ROS wheels: definitions of one package -> C, C++ and Python
sources.

    python generators.py PACKAGE FOLDER WORK

A program of its own, because the generators change global state. The steps are those of
`rosidl_generate_interfaces` in CMake (rosidl 4.6, Jazzy), with the typesupports that rmw_fastrtps
needs.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

KINDS = ("msg", "srv", "action")
TYPESUPPORTS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c")
"""What rmw_fastrtps serialises with, and what it describes types to other participants with."""
INTROSPECTION = "introspection"
"""Folder of its own for that generator, whose files have the names of another's."""


class Generation:
    """Sources of one package in `work / package`, which is the Python package too, and `work /
    introspection`.
    """

    def __init__(self, package: str, folder: Path, work: Path, prefix: Path) -> None:
        self._package = package
        self._output = work / package
        self._share = prefix / "share"
        self._arguments = work / "arguments.json"
        self._idls: list[Path] = []
        self._sources: list[Path] = []
        for kind in KINDS:
            if (folder / kind).is_dir():
                shutil.copytree(folder / kind, self._output / kind)

    def run(self) -> None:
        """All steps in order."""
        import rosidl_generator_c  # type: ignore[import-untyped]
        import rosidl_generator_py  # type: ignore[import-untyped]
        import rosidl_generator_type_description  # type: ignore[import-untyped]
        import rosidl_typesupport_c  # type: ignore[import-untyped]
        import rosidl_typesupport_fastrtps_c  # type: ignore[import-untyped]
        import rosidl_typesupport_introspection_c  # type: ignore[import-untyped]

        self._translate()
        self._call(
            "rosidl_generator_type_description",
            rosidl_generator_type_description.generate_type_hash,
        )
        for generator in ("rosidl_generator_c", *TYPESUPPORTS):
            self._write_visibility(generator)
        self._call("rosidl_generator_c", rosidl_generator_c.generate_c)
        self._call(TYPESUPPORTS[0], rosidl_typesupport_fastrtps_c.generate_typesupport_fastrtps_c)
        # files of the same names as above
        self._call(TYPESUPPORTS[1], rosidl_typesupport_introspection_c.generate_c)
        self._call("rosidl_typesupport_c", rosidl_typesupport_c.generate_c, TYPESUPPORTS)
        self._call("rosidl_generator_py", rosidl_generator_py.generate_py, ["rosidl_typesupport_c"])

    def _translate(self) -> None:
        from rosidl_adapter import convert_to_idl  # type: ignore[import-untyped]

        for kind in KINDS:
            for source in sorted((self._output / kind).glob(f"*.{kind}")):
                relative = source.relative_to(self._output)
                self._sources.append(source)
                self._idls.append(
                    convert_to_idl(self._output, self._package, relative, self._output)
                )

    def _place(self, generator: str) -> Path:
        return (
            self._output
            if generator != TYPESUPPORTS[1]
            else self._output.parent / INTROSPECTION / self._package
        )

    def _write_visibility(self, generator: str) -> None:
        name = f"{generator}__visibility_control.h"
        text = (self._share / generator / "resource" / f"{name}.in").read_text(encoding="utf-8")
        text = text.replace("@PROJECT_NAME_UPPER@", self._package.upper()).replace(
            "@PROJECT_NAME@", self._package
        )
        place = self._place(generator) / "msg" / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text, encoding="utf-8")

    def _call(
        self, generator: str, function: Callable[..., object], *arguments: Sequence[str]
    ) -> None:
        relative = [path.relative_to(self._output).as_posix() for path in self._idls]
        others = [
            path for path in sorted(self._share.glob("*/*/*.idl")) if path.parent.name in KINDS
        ]
        described = {name: str((self._output / name).with_suffix(".json")) for name in relative}
        facts = {
            "package_name": self._package,
            "output_dir": str(self._place(generator)),
            "template_dir": str(self._share / generator / "resource"),
            "idl_tuples": [f"{self._output}:{name}" for name in relative],
            "ros_interface_dependencies": [f"{path.parents[1].name}:{path}" for path in others],
            "ros_interface_files": [str(path) for path in self._sources],
            "target_dependencies": [],
            "include_paths": sorted(
                {f"{path.parents[1].name}:{path.parents[1]}" for path in others}
            ),
        }
        if generator != "rosidl_generator_type_description":
            facts["type_description_tuples"] = [
                f"{name}:{place}" for name, place in described.items()
            ]
        self._arguments.write_text(json.dumps(facts), encoding="utf-8")
        function(str(self._arguments), *arguments)


if __name__ == "__main__":
    Generation(
        sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), Path(os.environ["AMENT_PREFIX_PATH"])
    ).run()
