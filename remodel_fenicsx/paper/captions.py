"""Titles and captions of the figures: they stand in the files of the pictures and in docs/verification.md."""

CHAINS = (
    "Black: the four chains of each element's mean cell, deformed and projected on its face, cut off before its edge."
)
PEELED = "the outer layers of elements cut shorter than the inner ones"
WALL = "coloured by the deformed angle of the chains in the wall"
PROFILE = "reference fibre angle over the radius at t = 150; lines: means of the element layers, bands: all elements"
RELAXED = (
    "The printed pass over-corrects with {}: here it is relaxed by one half, in the material frame "
    "(docs/theory.md, Stability of the pass)."
)

CAPTIONS: dict[str, tuple[str, str]] = {
    "fig1": (
        "Force of a single chain (Fig. 1)",
        "Force of a wormlike chain, eq. (2), for kθ = 1 and three persistence lengths A. It locks at r = L (dotted).",
    ),
    "fig5": (
        "Alignment of the chains of a cube under tension (Fig. 5)",
        "Mean reference angle between chains and load for four values of κ. Circles: closed form of the same cells.",
    ),
    "fig6": (
        "Cylindrical tendon under uniaxial tension (Fig. 6)",
        "(a) Stretch over time; points: the times of the pictures. (b) to (f) Its elements by their deformed angle "
        f"between chains and load axis. {CHAINS}",
    ),
    "fig7": (
        "Artery under axial elongation and inner pressure (Fig. 7)",
        f"(a) to (e) The wall at five times, {WALL}; below, the loads. {CHAINS}",
    ),
    "fig8": (
        "Chains in the layers of the artery's wall (Fig. 8)",
        f"(a) The innermost, (b) the fourth and (c) the outermost of eight layers of elements at t = 150, {WALL}. "
        f"{CHAINS}",
    ),
    "fig9": (
        "Load cases from pure elongation to pure pressure (Fig. 9)",
        f"(a) to (e) The wall at t = 150 under five pairs of axial elongation and inner pressure p, {PEELED}, {WALL}. "
        f"{CHAINS}",
    ),
    "fig10": (
        "Remodeling driven by the Cauchy or the second Piola-Kirchhoff stress (Fig. 10)",
        f"(a) {PROFILE.capitalize()}. (b), (c) The wall, {PEELED}. {CHAINS} {RELAXED.format('S')}",
    ),
    "fig11": (
        "Remodeling driven by the Cauchy stress or the Finger tensor (Fig. 11)",
        f"(a) {PROFILE.capitalize()}. (b), (c) The wall, {PEELED}. {CHAINS} {RELAXED.format('b')}",
    ),
    "rate": (
        "Eqs. (10) and (11) on the same artery (erratum 7)",
        "(a) Mean reference fibre angle of the innermost, middle and outermost elements over time. "
        f"(b) {PROFILE.capitalize()}.",
    ),
    "energy": (
        "Stored energy and power of remodeling (Remark 6)",
        "(a) to (c) Stored energy. (d) to (f) Power of each step's remodeling pass; green: it releases stored energy, "
        "red: it takes energy in. Dotted: end of the ramp.",
    ),
}
