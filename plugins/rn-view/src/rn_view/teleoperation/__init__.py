"""Teleoperation from the page: sticks, keys and gamepads."""
