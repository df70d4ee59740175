"""OpenVLA-OFT behind the fixed action contract; builds on the public modules of rn-backend-openvla."""
