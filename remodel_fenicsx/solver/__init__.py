"""Equilibrium at fixed loads: residual, tangent, Newton's method, linear systems, increments."""
