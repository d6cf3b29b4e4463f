"""The way through time: steps, remodeling passes, and how equilibrium and cells are coupled."""
