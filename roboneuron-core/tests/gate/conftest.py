"""Tests of the limiter share an arm whose numbers are worked out by hand, in `gantry.py`."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent))
