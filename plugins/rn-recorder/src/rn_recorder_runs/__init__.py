"""Runs on disk: the recorder's process, its files, and their uses."""
