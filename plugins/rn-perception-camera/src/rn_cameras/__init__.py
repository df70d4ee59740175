"""The command `roboneuron robot cameras`: list cameras, print a calibration board, calibrate."""
