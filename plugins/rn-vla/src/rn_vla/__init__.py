"""Common interfaces of VLA packages: backends, runtimes and accelerations use them, without
importing each other.

`decoding` is the interface between backend and runtime, `pruning` that between runtime and
acceleration. `checkpoint_files` reads untrusted files, `rotation` converts the rotations of
training data, `openvla` is OpenVLA's network and files, `testing` is for contract tests of
runtimes.
"""
