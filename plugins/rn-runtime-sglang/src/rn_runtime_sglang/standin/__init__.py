"""A server with the interface of SGLang 0.5.23 that computes nothing: for tests and the contract
kit, without SGLang.
"""
