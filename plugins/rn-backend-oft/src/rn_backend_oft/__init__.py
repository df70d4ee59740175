"""OpenVLA-OFT behind the fixed action contract; builds on `rn_vla.openvla`."""
