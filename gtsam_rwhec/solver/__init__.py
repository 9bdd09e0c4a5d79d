"""Global solution and certificate of the RWHEC paper's problem: quadratic form, starts, descent, duals, relaxation."""
