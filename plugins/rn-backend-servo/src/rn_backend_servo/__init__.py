"""Classical visual servoing: picks up the cube named by the instruction, using only images and
proprioception.
"""
