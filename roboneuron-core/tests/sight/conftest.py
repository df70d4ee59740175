"""Tests of sight share a cell of painted cubes, in `painted_cell.py`."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent))
