"""Code that runs inside the SGLang process: the OpenVLA model, its image processor and their
registration.

A robot's own processes import only `fingerprint` and `versions`, which are light.
"""
