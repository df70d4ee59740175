"""The plugin system: descriptors (specs), hooks (hookspecs) and discovery.

Standard library and pluggy only, so that listing plugins costs no heavy import.
"""
