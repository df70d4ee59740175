"""Tests of tasks share a robot with a clock of its own, in `task_cell.py`."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent))
