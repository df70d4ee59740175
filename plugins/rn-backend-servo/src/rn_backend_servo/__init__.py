"""Classical visual servoing: picks up the cube that the instruction names, from images and
proprioception alone.
"""
