"""The made-up robot cell of ``data/cell``: how its pictures are drawn, and what stands where."""
