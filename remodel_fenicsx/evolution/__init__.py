"""Time integration: steps, remodeling passes, and the coupling of equilibrium and cells."""
