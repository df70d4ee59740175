"""A server that speaks like SGLang 0.5.23 and computes nothing: for tests and the contract kit,
without SGLang.
"""
