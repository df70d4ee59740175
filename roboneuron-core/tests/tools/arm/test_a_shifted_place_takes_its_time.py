"""place of what a policy grasped, shifted by dx_m and dy_m, moves at the asked speed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from roboneuron import Pose
from roboneuron.tools.arm.place_plans import PlaceArguments
from roboneuron.tools.arm.placing import Placer

FASTEST = (0.25, 1.0)
START = Pose(
    position_m=np.array([0.4, 0.0, 0.2]), quaternion_xyzw=np.array([1.0, 0.0, 0.0, 0.0]), stamp_ns=1
)


@pytest.mark.parametrize("speed", [0.1, 0.5, 1.0])
def test_no_part_of_a_shifted_place_is_faster_than_asked(speed: float) -> None:
    mover: Any = SimpleNamespace(fastest=FASTEST)
    grip: Any = SimpleNamespace(profile=None)
    arguments = PlaceArguments(dx_m=0.3, dy_m=-0.2, height_m=0.02, speed=speed)
    route = Placer(mover, grip).route(arguments, START)
    parts = (*route.carry, *route.leave)
    way_m = [np.linalg.norm([part.dx_m, part.dy_m, part.dz_m]) for part in parts]
    assert sum(way_m) > 0.5
    for part, far_m in zip(parts, way_m, strict=True):
        if speed == 1.0:
            assert part.duration_s is None, "move_ee takes the fastest by itself"
        else:
            assert part.duration_s is not None
            assert far_m / part.duration_s <= speed * FASTEST[0] + 1e-9
