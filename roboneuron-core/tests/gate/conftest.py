"""Tests of the limiter share arms whose numbers are worked out by hand, in `gantry.py` and
`planar.py`.
"""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent))
