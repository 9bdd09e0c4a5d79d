"""From a log and a rig file to a calibration: detect, clean, solve; each stage reads the log of the one before it."""
