"""Measurements to try the library on: the shipped log, and public data to download."""
