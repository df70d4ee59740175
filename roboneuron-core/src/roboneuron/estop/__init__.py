"""The emergency stop, from the file that stops every process to the command that a person types.

`latch` is the stop, `latch_file` its file, `pin` what a release may ask for: every process uses
them. The server adds `emergency`, which also stops by the topic and believes modules only when they
confirm it, and `motion_starts`, after which nothing moves until somebody asks for it. `command` is
`roboneuron estop`.
"""

from roboneuron.estop.latch import EmergencyStopLatch
from roboneuron.estop.latch_file import ESTOP_FILE, RESET_SUFFIX, LatchState

__all__ = [
    "ESTOP_FILE",
    "RESET_SUFFIX",
    "EmergencyStopLatch",
    "LatchState",
]
