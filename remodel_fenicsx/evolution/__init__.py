"""The way through time: equilibrium, remodeling pass, steps."""
