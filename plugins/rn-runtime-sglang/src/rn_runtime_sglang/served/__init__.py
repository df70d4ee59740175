"""What runs inside the SGLang process: the OpenVLA model, its image processor and their
registration.

Nothing here is imported by a robot's own processes except `fingerprint` and `versions`, which are
light.
"""
