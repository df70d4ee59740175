"""docs/reference/aarch64.md: its table has every distribution, and the overrides every
package of ROS.
"""

from __future__ import annotations

import re

import aarch64
import pytest


def test_the_table_has_every_distribution_and_extra():
    named = re.findall(r"^\| `([^`]+)` \|", aarch64.told(), flags=re.MULTILINE)
    assert named == [f"{name}[{extra}]" if extra else name for name, extra in aarch64.cases()]


def test_every_package_of_ros_is_left_to_the_sourced_installation():
    """Those that the index has for x86-64 only: without an override nothing installs there."""
    left_out = aarch64.overrides(aarch64.sourced_packages())
    needed = {"ros-jazzy-rclpy", "ros-jazzy-common-interfaces", "ros-jazzy-lifecycle-msgs"}
    assert needed <= {line.partition(";")[0] for line in left_out.splitlines()}


@pytest.mark.parametrize(
    ("told", "names"),
    [
        ("Because a-b==1.0 has no wheels with a matching platform tag", ["a-b"]),
        ("Because all versions of a_b have no wheels with a matching platform tag", ["a_b"]),
        ("Because a.b==1 has no usable wheels and only a.b<=1 is available", ["a.b"]),
        ("Because a was not found in the package registry", []),
    ],
)
def test_what_lacks_a_wheel_is_read_from_the_error(told, names):
    assert aarch64.missing_wheels(told) == names


def test_a_changed_verdict_is_seen_and_another_number_is_not(monkeypatch, capsys):
    monkeypatch.setattr(aarch64, "told", lambda: "| `a` | yes | 3 |\n| `b` | yes | 4 |")
    for row, code in (("| `b` | yes | 9 |", 0), ("| `b` | no: c | 9 |", 1)):
        monkeypatch.setattr(aarch64, "table", lambda uv, row=row: f"| `a` | yes | 3 |\n{row}")
        assert aarch64.main([]) == code
    assert "`b`" in capsys.readouterr().err
