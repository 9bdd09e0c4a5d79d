"""A result file, as the page on files reads it; after rig.py."""

rw.write_calibration(rw.calibrate(problem), "calibration.json")  # noqa: F821
