"""One equilibrium at given loads: residual and tangent, Newton's method, its linear systems, its load increments."""
