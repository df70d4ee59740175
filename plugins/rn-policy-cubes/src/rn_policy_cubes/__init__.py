"""A small vision-language-action policy for the suite "cubes", in the public layout of
OpenVLA-OFT.
"""
