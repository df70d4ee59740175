"""OpenVLA behind the fixed action contract; network, files and conversions are those of
`rn_vla.openvla`.
"""
