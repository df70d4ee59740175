"""The emergency stop, from the latch file that stops every process to the command for users.

`latch` is the stop, `latch_file` its file, `pin` the PIN for a release: every process uses them.
The server adds `emergency`, which also stops by the topic and waits for confirmation by the
modules, and `motion_starts`, which keeps the robot still after a stop until motion is requested.
`command` is `roboneuron estop`.
"""

from roboneuron.estop.latch import EmergencyStopLatch
from roboneuron.estop.latch_file import ESTOP_FILE, RESET_SUFFIX, LatchState

__all__ = [
    "ESTOP_FILE",
    "RESET_SUFFIX",
    "EmergencyStopLatch",
    "LatchState",
]
