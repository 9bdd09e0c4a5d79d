"""Calibrations in files: one schema, written and read."""
