"""Pictures and animations of a run's body, and the body in PyVista. None of it needs dolfinx."""
