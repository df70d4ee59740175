"""Selection of what start tools run, by agents and within the configured restrictions: a feature of
RoboNeuron.
"""
