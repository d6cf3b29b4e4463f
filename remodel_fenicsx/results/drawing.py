"""What pictures of bodies have in common, figures and reports alike: colours of angles, how chains are drawn."""

from __future__ import annotations

LEVELS = 18  # steps of 5 degrees: a colour can be read off the scale
# matplotlib's RdYlBu in LEVELS equal steps: red along the first direction (0 degrees), blue across it (90)
ANGLE_COLOURS = (
    "#a50026", "#c21c27", "#dc3b2c", "#ed5f3c", "#f7844e", "#fcaa5f", "#fec87a", "#fee496", "#fff6b1",
    "#f6fbd0", "#e4f4f1", "#c7e7f1", "#a8d6e8", "#87bdd9", "#69a0ca", "#4d7fb9", "#3d5ba7", "#313695",
)  # fmt: skip
CHAIN_COLOUR = (0.08, 0.08, 0.10)
CHAIN_REACH = 0.39  # half a chain's length over the shorter side of its face, both undeformed
CHAIN_ROOM = 0.78  # how far a chain goes at most, over the way from the middle to the edge of its face
CHAIN_WIDTH = 0.06  # over the shorter side
CHAIN_LIFT = 0.2  # towards the eye, over the same: faces need not be plane
AMBIENT = 0.8  # share of a colour that does not depend on where its face looks: it must mean the same everywhere
