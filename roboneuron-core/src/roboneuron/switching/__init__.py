"""Warm switching of backends, camera sources and controllers, a feature of RoboNeuron."""
