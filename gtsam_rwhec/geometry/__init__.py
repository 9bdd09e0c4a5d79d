"""Poses as users give them, checked; and covariances of poses between frames and conventions."""
