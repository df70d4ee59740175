"""Playback of a recorded run: position, speed, and the controls on the page."""
