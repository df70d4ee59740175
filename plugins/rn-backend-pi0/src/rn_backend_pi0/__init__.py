"""Backends for pi0: native PyTorch inference from public checkpoints."""
