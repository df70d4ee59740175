"""Makes the mutants of `mutants/` importable by the tests and by the targets that name them."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent / "mutants"))
