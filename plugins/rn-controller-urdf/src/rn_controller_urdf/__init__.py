"""Controller for any URDF arm: converts TCP deltas to joint positions by differential inverse
kinematics, or refuses.
"""
