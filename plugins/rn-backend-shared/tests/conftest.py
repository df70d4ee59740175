"""Modules beside the tests, and machines of those of rn-link."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent))  # for policy_servers and alike
sys.path.append(str(Path(__file__).parents[2] / "rn-link" / "tests"))  # for link_machines
