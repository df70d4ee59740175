"""Make the modules next to the tests importable."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent))  # for own_robots and stand_in_follower
