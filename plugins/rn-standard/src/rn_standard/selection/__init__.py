"""Choice of what start tools run, by agents and within what the configuration allows: a feature of
RoboNeuron.
"""
