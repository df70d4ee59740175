"""Evaluation of policies over many simulated episodes."""
