"""Pictures and animations of a run's body, and how bodies are drawn for figures too.

`draw_picture` and `draw_animation` make a file of a run's folder. `bodies.body` gives the surface of a `DrawnBody` and
its chains as patches, `rendering.add_patches` puts them into a PyVista plotter. None of it needs dolfinx.
"""
