"""Module processes from the outside: spawned, driven through their lifecycle, watched, and ended
without a trace.
"""
