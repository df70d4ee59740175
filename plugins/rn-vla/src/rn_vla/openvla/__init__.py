"""OpenVLA's public layout: files, network, prompt, pixels and action values; OpenVLA-OFT has the
same base.
"""
