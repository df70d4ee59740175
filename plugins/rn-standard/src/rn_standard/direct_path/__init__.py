"""The direct path: one gate that every message, request and goal for an agent passes before it is
sent.
"""
