"""OpenVLA's public layout: files, network, prompt, pixels and action values; OpenVLA-OFT uses the
same base.
"""
