"""What the user states: measurements by pair, scale, priors and known frames; and the moments that hold all of it."""
