"""What simulated robots share: the choice of an engine, real time, and MuJoCo's reading of URDF and
casting of rays.
"""
