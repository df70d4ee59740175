"""Teleoperation from the page: sliders with a goal for followers; sticks, keys and gamepads."""
