"""Backends for pi0: native PyTorch inference from public checkpoints, and a client of the openpi
policy server.
"""
