"""What joins solving and refinement."""
