"""Shared parts of simulated robots: choice of the engine, real-time stepping, and MuJoCo's URDF
import and ray casting.
"""
