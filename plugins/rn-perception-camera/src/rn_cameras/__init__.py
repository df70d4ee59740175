"""The command `roboneuron cameras`: list cameras, print a calibration board, calibrate."""
