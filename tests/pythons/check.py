"""The embedded default and the bases on other Python versions: installed as by a user, each in a
fresh environment.

    make test-pythons                                       # python3.11, python3.12 and python3.13
    make test-pythons PYTHONS="/opt/python3.12/bin/python"

For each interpreter: pip installs the packages (wheels only: nothing is compiled), `roboneuron
doctor` finds the expected engine, `roboneuron demo` lifts a cube as judged by the simulator, and
the three bases drive their paths. Exit status 0 means that everything worked everywhere. It takes
about three minutes per version, mostly for pip.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("--requirement", str(ROOT / "requirements.txt"), str(ROOT / "plugins/rn-robot-bases"))
NOT_COMPILED = "pybullet,mujoco,numpy,pin,coal,pillow"
INSTALL_LIMIT_S, RUN_LIMIT_S = 1200, 600


def run(command: list[str], folder: Path, limit_s: float, env: dict[str, str]) -> str:
    """Run `command` in `folder`; return its output. Ends the check if it fails."""
    done = subprocess.run(
        command, cwd=folder, env=env, capture_output=True, text=True, timeout=limit_s, check=False
    )
    if done.returncode != 0:
        sys.exit(
            f"FAILED ({done.returncode}): "
            f"{' '.join(command)}\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}"
        )
    return done.stdout


def clean_environment(folder: Path) -> dict[str, str]:
    """Variables for another environment, with a state folder of its own."""
    # A virtual environment passes paths of its ROS to its children; another one must not inherit
    # them.
    inherited = ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH", "PYTHONPATH")
    env = {name: value for name, value in os.environ.items() if name not in inherited}
    return env | {"XDG_STATE_HOME": str(folder / "state"), "COLUMNS": "200"}


def expected_engine(python: Path, env: dict[str, str], folder: Path) -> str:
    """PyBullet if it has a wheel, otherwise MuJoCo."""
    asked = (
        "import platform, sys; print(sys.version_info < (3, 12) and platform.machine() == 'x86_64')"
    )
    return (
        "pybullet"
        if run([str(python), "-c", asked], folder, 60, env).strip() == "True"
        else "mujoco"
    )


def check(interpreter: str, folder: Path) -> None:
    """All steps with one interpreter."""
    env = clean_environment(folder)
    run([interpreter, "-m", "venv", str(folder / "venv")], folder, 300, env)
    python, roboneuron = folder / "venv/bin/python", folder / "venv/bin/roboneuron"
    install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    wheels = ["--only-binary", NOT_COMPILED, "--constraint", str(ROOT / "constraints.txt")]
    run([*install, *wheels, *PACKAGES], ROOT, INSTALL_LIMIT_S, env)
    engine = expected_engine(python, env, folder)
    found = run([str(roboneuron), "doctor"], folder, RUN_LIMIT_S, env)
    if f"simulated with {engine})" not in found:
        sys.exit(f"doctor does not say that the FR3 is simulated with {engine}:\n{found}")
    run([str(roboneuron), "demo", "--seed", "1"], folder, RUN_LIMIT_S, env)
    run([str(python), str(ROOT / "examples/drive_bases.py")], folder, RUN_LIMIT_S, env)
    version = run(
        [str(python), "-c", "import platform; print(platform.python_version())"], folder, 60, env
    ).strip()
    print(
        f"Python {version}: installed without compiling, demo and bases succeed with {engine}",
        flush=True,
    )


def main() -> None:
    """Check every interpreter named on the command line."""
    missing = [name for name in sys.argv[1:] if shutil.which(name) is None]
    if missing or not sys.argv[1:]:
        sys.exit(
            f"Not found: {', '.join(missing)}."
            if missing
            else "Name at least one Python interpreter."
        )
    for interpreter in sys.argv[1:]:
        with tempfile.TemporaryDirectory(prefix="rn-python-") as folder:
            check(interpreter, Path(folder))


if __name__ == "__main__":
    main()
