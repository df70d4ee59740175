"""Supervision of module processes: spawn them, drive their lifecycle, monitor and terminate
them.
"""
