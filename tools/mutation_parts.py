"""The parts of the safety code that tools/mutations.py mutates, and the tests that must detect
it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CORE = "roboneuron-core/src/roboneuron"
MODULE_TESTS = ("roboneuron-core/tests/modules",)
SUPERVISOR_TESTS = ("roboneuron-core/tests/supervisor",)
CORE_TESTS = ("roboneuron-core/tests/gate", *MODULE_TESTS, *SUPERVISOR_TESTS)
DIRECT_TESTS = ("roboneuron-core/tests/direct_path",)
ARM_TESTS = (
    *("roboneuron-core/tests/tools/arm", "plugins/rn-controller-urdf/tests"),
    "tests/safety/test_an_arm_that_was_held_up_catches_up_nothing.py",
    "tests/safety/test_fr3_brakes_before_its_limits.py",
    "tests/safety/test_joint_motions_keep_clear_of_links_and_table.py",
)
DIRECT_ARM_TESTS = (
    "roboneuron-core/tests/tools/arm",
    "tests/safety/test_joint_motions_keep_clear_of_links_and_table.py",
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Part:
    """A part of the code.

    Attributes:
        package: folder, relative to the repository's root.
        files: files or patterns of files to mutate, relative to the package.
        tests: folders and files of tests, relative to the repository's root.
        functions: the only functions to mutate, without their class; empty for all.
    """

    package: str
    files: tuple[str, ...]
    tests: tuple[str, ...]
    functions: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def patterns(self) -> tuple[str, ...]:
        """Patterns of the mutants' names for mutmut; empty for all."""
        if not self.functions:
            return ()
        found = []
        for file in self.files:
            module = file.removesuffix(".py").replace("/", ".")
            for function in self.functions.get(file, ("",)):
                found.append(f"*{module}.x*{function}__mutmut_*")
        return tuple(found)


PARTS = {
    "gate": Part(
        package=CORE,
        files=(
            "gate/motion/*.py",
            "estop/latch.py",
            "estop/latch_file.py",
            "gate/audit.py",
            "estop/pin.py",
        ),
        tests=(*CORE_TESTS, *DIRECT_TESTS, *ARM_TESTS),
    ),
    "modules": Part(
        package=CORE,
        files=("modules/holding.py", "modules/joint_watch.py", "modules/robot.py"),
        tests=MODULE_TESTS,
    ),
    "control": Part(package=CORE, files=("modules/control/module.py",), tests=MODULE_TESTS),
    "supervisor": Part(
        package=CORE,
        files=tuple(
            f"supervisor/{name}.py" for name in ("process", "changes", "slot", "supervisor")
        ),
        tests=SUPERVISOR_TESTS,
        functions={
            "supervisor/changes.py": ("tell", "held_s", "wait_for"),
            "supervisor/slot.py": ("begin_stop", "settle", "cancel", "note_exit"),
            "supervisor/supervisor.py": (
                *("stop", "end", "cancel", "stop_all", "close"),
                *("_finish", "_deactivate", "_settle", "_await_settled", "_beat"),
            ),
        },
    ),
    "direct-path": Part(
        package=CORE,
        files=(
            *(
                f"gate/motion/{name}.py"
                for name in ("path_limits", "path_watch", "joint_paths", "acceleration")
            ),
            "modules/arm_paths.py",
            "estop/motion_claims.py",
            *(
                f"direct_path/{name}.py"
                for name in (
                    *("gate", "motion_gate", "limits", "rate"),
                    *("arbiter", "allow_list", "twists"),
                )
            ),
        ),
        tests=(*DIRECT_TESTS, *DIRECT_ARM_TESTS),
    ),
}
