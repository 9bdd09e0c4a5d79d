"""The carriers' motion over time."""
