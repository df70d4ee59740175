"""Tests of tasks share a robot with a clock of its own, in `task_cell.py`."""
