"""The plugin system: what plugins may offer (specs), how they say so (hookspecs), how they are
found (discovery).

Standard library and pluggy only, so that listing plugins costs no heavy import.
"""
