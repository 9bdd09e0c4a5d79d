"""Global solution and certificate of the RWHEC paper's problem: quadratic form, starts, descent, duals, relaxation."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
