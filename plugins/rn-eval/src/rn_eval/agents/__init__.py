"""Evaluation of agents that operate a robot through the server's tools."""
