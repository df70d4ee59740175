"""Test counterpart, not part of the driver: a strict control box in front of franka-sim."""
