"""Chunk execution: rules that decide when to predict and which rows to send. No thread, no ROS, no clock of its own."""

from roboneuron.modules.execution.executor import Bounds, ChunkExecutor, Execution, Prediction
from roboneuron.modules.execution.latency import LatencyWindow
from roboneuron.modules.execution.meter import Delivery
from roboneuron.modules.execution.mode import MODES, Abilities, Choice, Mode
from roboneuron.modules.execution.queue import Outcome, Row, RowQueue, cross_fade
from roboneuron.modules.execution.roll_forward import roll_forward

__all__ = [
    "MODES",
    "Abilities",
    "Bounds",
    "Choice",
    "ChunkExecutor",
    "Delivery",
    "Execution",
    "LatencyWindow",
    "Mode",
    "Outcome",
    "Prediction",
    "Row",
    "RowQueue",
    "cross_fade",
    "roll_forward",
]
