"""What the paper says: chains, energy, drivers, laws, unit cells. Plain functions on arrays or UFL, no mesh."""
