"""The direct path: one gate checks every message, request and goal of an agent before it is
sent.
"""
