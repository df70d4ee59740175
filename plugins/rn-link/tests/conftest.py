"""Import path of the modules next to the tests."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent))  # for link_machines and others
