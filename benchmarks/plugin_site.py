"""Plugins for one run only: installed in a folder, found by this process and its children."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rn_testing.domain import free_ros_domain

HERE = Path(__file__).parent


@contextmanager
def installed(
    folder: Path, distribution: str, modules: tuple[str, ...], *, source: Path = HERE
) -> Iterator[None]:
    """Install modules of `source` below `folder`, on a ROS domain of their own.

    Args:
        folder: folder for the installation and ROS's logs; an existing installation is used.
        distribution: its name.
        modules: names without `.py`; the first one is the plugin.
        source: directory of the modules; by default that of the benchmarks.
    """
    site = folder / "site"
    if not site.exists():
        info = site / f"{distribution.replace('-', '_')}-1.0.dist-info"
        info.mkdir(parents=True)
        for module in modules:
            shutil.copy(source / f"{module}.py", site)
        (info / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n"
        )
        (info / "entry_points.txt").write_text(f"[roboneuron]\n{distribution} = {modules[0]}\n")
    before = {key: os.environ.get(key) for key in ("PYTHONPATH", "ROS_DOMAIN_ID", "ROS_LOG_DIR")}
    os.environ["PYTHONPATH"] = os.pathsep.join(
        p for p in (str(site), before["PYTHONPATH"] or "") if p
    )
    os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
    os.environ["ROS_LOG_DIR"] = str(folder / "ros")
    sys.path.insert(0, str(site))
    try:
        yield
    finally:
        sys.path.remove(str(site))
        for key, value in before.items():
            os.environ.pop(key, None)
            if value is not None:
                os.environ[key] = value


def chunks(rows: int, delay_ms: float, rate_hz: float) -> str:
    """Options of a backend that answers with this delay and number of rows, one per period of the
    camera; empty for one row.
    """
    return (
        "" if rows == 1 else f"rows = {rows}\nstep_s = {1 / rate_hz}\ndelay_s = {delay_ms / 1e3}\n"
    )
