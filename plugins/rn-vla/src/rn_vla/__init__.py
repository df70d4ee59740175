"""What packages of VLA models share: backends, runtimes and accelerations agree here, without
importing each other.

`decoding` is what a backend gives a runtime, `pruning` what an acceleration gets of one,
`checkpoint_files` reads files that nobody vouches for, `rotation` converts the rotations of
training data, `openvla` is OpenVLA's network and files, `testing` what contract tests of runtimes
use.
"""
