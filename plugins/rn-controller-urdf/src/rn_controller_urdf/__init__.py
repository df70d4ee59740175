"""Controller for any URDF arm: TCP deltas to joint positions by differential inverse kinematics, or
a refusal.
"""
