"""The drawings of docs/concepts.md: the unit cell and its remodeling, the tube, and the workflow. They need no run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, FancyBboxPatch, Rectangle, Wedge

from docs.making.pages import FIGURES, drawn
from remodel_fenicsx.results.recording import ANGLE_COLOURS
from remodel_fenicsx.studies.study import COLOURS, Page

DEPTH = np.array([0.46, 0.2])  # where a unit of the third axis goes on the paper
BLUE, RED = COLOURS[:2]
TURN = np.radians(-14.0)  # of the principal stresses of the cell
TISSUE = "#e6e0d6"
CELL = (
    "The eight-chain unit cell and its remodeling",
    "a: the isotropic cell before any load; b: its axes follow the principal stresses; c: its dimensions follow "
    "gradually, and no chain is left along a principal stress that is not a tension.",
)
TUBE = (
    "The tube: supports, loads, axes and fibre angles",
    "a: a section along the tube, with its loads and the supports of its ends; b: a section across it, with the local "
    "axes and the bands of the angle columns; c: fibre angles and their colours in all pictures.",
)
WORKFLOW = ("From a scan or data to fibre angles", "Files in white, commands in blue.")


def arrow(axes: Axes, start: Sequence[float], end: Sequence[float], **style: object) -> None:
    """Draw an arrow between two points of the data."""
    looks = {"arrowstyle": "-|>", "color": "black", "lw": 1.2, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", end, start, arrowprops=looks | style)


def blank(axes: Axes, letter: str, title: str) -> None:
    """Leave only what is drawn, at equal scales."""
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title(title, fontsize=8.5)
    axes.set_title(letter, loc="left", fontweight="bold")


# ---------------------------------------------------------------- the unit cell
def corners(dimensions: Sequence[float], turn: float) -> np.ndarray:
    """Return the eight corners of a cell on the paper, with half edges l_I along its axes (8, 2)."""
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij")).reshape(3, -1).T
    return (signs * dimensions) @ directions(turn)


def directions(turn: float) -> np.ndarray:
    """Return the axes n_I on the paper (3, 2): the first two turn in its plane."""
    cosine, sine = np.cos(turn), np.sin(turn)
    return np.array([[cosine, sine], [-sine, cosine], DEPTH])


def draw_cell(axes: Axes, dimensions: Sequence[float], turn: float, slack: float) -> None:
    """Draw a box with its eight chains, which are wavy while they are slack."""
    ends = corners(dimensions, turn)
    for first, second in ((i, j) for i in range(8) for j in range(i) if bin(i ^ j).count("1") == 1):
        axes.plot(*ends[[first, second]].T, color="0.45", lw=0.9)
    along = np.linspace(0, 1, 121)
    for number, end in enumerate(ends):
        across = np.array([-end[1], end[0]]) / np.linalg.norm(end)
        wave = slack * np.sin(2 * np.pi * (5 + number % 3) * along) * np.sin(np.pi * along)
        axes.plot(*(along[:, None] * end + wave[:, None] * across).T, color=BLUE, lw=1.3)
    axes.plot(0, 0, "o", color=BLUE, ms=4)


def draw_axes_of_cell(axes: Axes, dimensions: Sequence[float], turn: float, reach: float) -> None:
    """Draw n_I as thin arrows from the faces of a cell."""
    for number, (size, along) in enumerate(zip(dimensions, directions(turn), strict=True), start=1):
        ahead = along / np.linalg.norm(along)
        start, end = size * along, size * along + reach * ahead
        arrow(axes, start, end, color="0.25", lw=0.9)
        axes.annotate(f"$n_{number}$", end + 0.12 * ahead, ha="center", va="center", color="0.25")


def draw_stresses(axes: Axes, dimensions: Sequence[float], labels: Sequence[str]) -> None:
    """Draw the principal stresses on the faces: two tensions, and a compression along the depth."""
    lengths = 0.5, 0.3, -1.55
    for number, size, along, length, label in zip((1, 2, 3), dimensions, directions(TURN), lengths, labels, strict=True):  # fmt: skip
        for side in (-1, 1):
            near, far = side * (size + 0.06) * along, side * (size + 0.06 + abs(length)) * along
            arrow(axes, *((near, far) if length > 0 else (far, near)), color=RED, lw=2.2)
        place, is_tension = -(size + 0.06 + abs(length)) * along, length > 0
        axes.annotate(label, place, (-9 if is_tension else -3, -9 if is_tension else -7),
                      textcoords="offset points", ha="center" if is_tension else "right",
                      va="center", color=RED)  # fmt: skip
        end = -place + (0.12 if is_tension else 0.2) * along / np.linalg.norm(along)
        axes.text(*end, f"$n_{number}$", ha="center", va="center", color="0.25")


def cell() -> Figure:
    """Draw the cell before, at and after remodeling."""
    figure = Figure(figsize=(7.4, 2.5), layout="constrained")
    panels = figure.subplots(1, 3)
    equal, later = (3**-0.5,) * 3, (0.88, 0.46, 0.06)
    blank(panels[0], "a", "before any load:\nisotropic cell, $l_1 = l_2 = l_3$")
    draw_cell(panels[0], equal, 0.0, 0.05)
    draw_axes_of_cell(panels[0], equal, 0.0, 0.42)
    bottom = corners(equal, 0.0)[:, 1].min() - 0.09
    left = corners(equal, 0.0)[0, 0]
    arrow(panels[0], (left, bottom), (left + equal[0], bottom), arrowstyle="<|-|>", lw=0.8)
    panels[0].text(left + equal[0] / 2, bottom - 0.03, "$l_1$", ha="center", va="top")
    panels[0].text(-1.0, -1.4, "chain: end-to-end length $r$,\nlocks at $r = L$", color=BLUE, fontsize=7.5)  # fmt: skip
    blank(panels[1], "b", "under load: the axes $n_I$ take\nthe principal directions of stress")
    draw_cell(panels[1], equal, TURN, 0.04)
    draw_stresses(panels[1], equal, ("$\\sigma_1$", "$\\sigma_2$", "$\\sigma_3 < 0$"))
    blank(
        panels[2],
        "c",
        "remodeled: $l_I$ tends to $r_0\\,\\sigma_I^+ / |\\sigma^+|$,\nand $l_3$ vanishes",
    )
    draw_cell(panels[2], later, TURN, 0.012)
    draw_stresses(panels[2], later, ("$\\sigma_1$", "$\\sigma_2$", "$\\sigma_3 < 0$"))
    chain = np.degrees(TURN + np.arctan2(later[1], later[0]))
    panels[2].add_patch(
        Arc((0, 0), 1.15, 1.15, theta1=np.degrees(TURN), theta2=chain, color="black")
    )
    panels[2].plot(
        *(np.linspace(0, 0.88, 2)[:, None] * directions(TURN)[0]).T, ":", color="black", lw=1
    )
    panels[2].text(*(0.68 * np.array([np.cos(TURN + 0.23), np.sin(TURN + 0.23)])), "$\\alpha$", ha="center", va="center")  # fmt: skip
    panels[2].text(-1.3, -1.36, "$\\tan\\alpha = l_2 / l_1$", fontsize=8)
    for axes in panels:
        axes.set(xlim=(-1.6, 1.6), ylim=(-1.4, 1.15))
    return figure


# ---------------------------------------------------------------- the tube
INNER, OUTER, LENGTH = 0.55, 1.0, 3.0


def draw_length(axes: Axes) -> None:
    """Draw the section along the tube: walls, pressure, rollers, elongation and axes."""
    for side in (-1, 1):
        low = min(side * INNER, side * OUTER)
        axes.add_patch(
            Rectangle((low, 0), OUTER - INNER, LENGTH, fc=TISSUE, ec="black", hatch="//", lw=1)
        )
        for height in np.linspace(0.35, LENGTH - 0.35, 5):
            arrow(axes, (side * 0.12, height), (side * (INNER - 0.02), height), color=RED)
        for x in np.linspace(low + 0.08, low + OUTER - INNER - 0.08, 3):
            axes.plot(x, -0.075, "o", mfc="white", mec="black", ms=4)
        middle = low + (OUTER - INNER) / 2
        arrow(axes, (middle, LENGTH + 0.03), (middle, LENGTH + 0.5), color=RED, lw=2)
    axes.plot([-1.2, 1.2], [-0.15, -0.15], color="black", lw=1.2)
    axes.plot([0, 0], [0, LENGTH], "-.", color="0.5", lw=0.8)
    axes.text(
        0,
        0.62,
        "$p$",
        color=RED,
        ha="center",
        va="center",
        bbox={"fc": "white", "ec": "none", "pad": 1},
    )
    axes.text(
        0,
        LENGTH + 0.3,
        "elongation or\naxial force",
        color=RED,
        ha="center",
        va="center",
        fontsize=7,
    )
    axes.text(
        0,
        -0.25,
        "ends keep their planes;\nfree to move radially",
        ha="center",
        va="top",
        fontsize=7,
    )
    arrow(axes, (1.35, 0), (1.35, 1.0), lw=1)
    axes.text(1.42, 0.95, "$z$", va="top")
    arrow(axes, (1.35, 0), (1.9, 0), lw=1)
    axes.text(1.9, 0.08, "$r$", va="bottom", ha="right")
    arrow(axes, (-1.25, 0), (-1.25, LENGTH), arrowstyle="<|-|>", lw=0.8)
    axes.text(-1.33, LENGTH / 2, "length", rotation=90, ha="right", va="center", fontsize=7.5)
    axes.set(xlim=(-1.75, 2.0), ylim=(-0.85, LENGTH + 0.65))


def draw_across(axes: Axes) -> None:
    """Draw the section across the tube: radii, bands and local axes."""
    axes.add_patch(Wedge((0, 0), OUTER, 0, 360, width=OUTER - INNER, fc=TISSUE, ec="black", lw=1))
    thickness = (OUTER - INNER) / 8
    for inside in (0, 3.5, 7):
        radius = INNER + (inside + 1) * thickness
        axes.add_patch(Wedge((0, 0), radius, 0, 360, width=thickness, fc="0.72", ec="none"))
    arrow(axes, (0, 0), (-INNER * 0.71, -INNER * 0.71), lw=0.9)
    axes.text(-0.28, -0.12, "$R_i$", ha="center")
    arrow(axes, (0, 0), (OUTER * 0.5, -OUTER * 0.866), lw=0.9)
    axes.text(0.13, -0.42, "$R_o$", ha="center")
    place = np.array([np.cos(np.radians(50)), np.sin(np.radians(50))]) * OUTER
    outward, around = place / OUTER, np.array([-place[1], place[0]]) / OUTER
    arrow(axes, place, place + 0.45 * outward, color=BLUE, lw=1.6)
    arrow(axes, place, place + 0.45 * around, color=BLUE, lw=1.6)
    axes.text(*(place + 0.56 * outward), "r", color=BLUE, ha="center", va="center")
    axes.text(*(place + 0.56 * around), "c", color=BLUE, ha="center", va="center")
    axes.plot(*place, "o", mfc="white", mec=BLUE, ms=6)
    axes.plot(*place, ".", color=BLUE, ms=3)
    axes.text(*(place + (0.17, -0.1)), "a", color=BLUE, ha="center", va="center")
    axes.text(0, -1.2, "c circumferential, a axial (towards\nyou), r radial; grey: bands of the columns\n"
              "..._inner, ..._middle and ..._outer", ha="center", va="top", fontsize=7)  # fmt: skip
    axes.set(xlim=(-1.45, 1.45), ylim=(-1.95, 1.5))


def draw_angles(axes: Axes) -> None:
    """Draw the quarter of all fibre angles in their colours, and three pieces of the wall."""
    steps = np.linspace(0, 90, len(ANGLE_COLOURS) + 1)
    for start, end, colour in zip(steps, steps[1:], ANGLE_COLOURS, strict=False):
        axes.add_patch(Wedge((0, 0), 1, start, end, width=0.55, fc=colour, ec="none"))
    arrow(axes, (0, 0), (1.3, 0), lw=1)
    arrow(axes, (0, 0), (0, 1.3), lw=1)
    axes.text(1.05, -0.09, "c: 0°", ha="center", va="top")
    axes.text(0.07, 1.27, "a: 90°", va="center")
    for angle in (30, 60):
        radian = np.radians(angle)
        axes.text(
            1.14 * np.cos(radian),
            1.14 * np.sin(radian),
            f"{angle}°",
            ha="center",
            va="center",
            fontsize=7,
        )
    for number, angle in enumerate((8.0, 45.0, 82.0)):
        left, colour = 0.62 * number - 0.35, ANGLE_COLOURS[int(angle / 90 * len(ANGLE_COLOURS))]
        axes.add_patch(Rectangle((left, -0.95), 0.55, 0.55, fc=colour, ec="0.4", lw=0.8))
        middle = np.array([left + 0.275, -0.675])
        for sign in (-1, 1):
            arm = 0.2 * np.array([np.cos(np.radians(angle)), sign * np.sin(np.radians(angle))])
            axes.plot(*np.array([middle - arm, middle + arm]).T, color="black", lw=1.6)
        axes.text(middle[0], -1.0, f"{angle:.0f}°", ha="center", va="top", fontsize=7.5)
    axes.text(
        0.55,
        -1.2,
        "pieces of the wall with the\nfour chains of their cell",
        ha="center",
        va="top",
        fontsize=7,
    )
    axes.set(xlim=(-0.45, 1.65), ylim=(-1.65, 1.5))


def tube() -> Figure:
    """Draw both sections and the angles."""
    figure = Figure(figsize=(7.4, 3.5), layout="constrained")
    panels = figure.subplots(1, 3, width_ratios=(3.0, 3.1, 2.4))
    for axes, letter, title, draw in zip(
        panels,
        "abc",
        (
            "along the tube: loads and supports",
            "across the tube: axes and bands",
            "fibre angles and colours",
        ),
        (draw_length, draw_across, draw_angles),
        strict=True,
    ):
        blank(axes, letter, title)
        draw(axes)
    return figure


# ---------------------------------------------------------------- the workflow
BOXES = {  # name: left, bottom, text, whether it is a command
    "scan": (0.0, 2.3, "surface of a lumen\n(scan: .stl, .vtp)", False),
    "wall": (2.2, 2.3, "wall", True),
    "mesh": (3.9, 2.3, "mesh\n(Gmsh, VMTK, ...)", False),
    "numbers": (0.0, 1.15, "shape, tissue, loads\n(papers, tests)", False),
    "scene": (3.9, 1.15, "scene.toml", False),
    "run": (6.1, 1.15, "validate, run", True),
    "folder": (7.8, 1.15, "history.csv\nfields.vtkhdf", False),
    "data": (0.0, 0.0, "measured curves\n(.csv)", False),
    "fit": (6.1, 0.0, "fit", True),
    "bands": (7.8, 0.0, "fitted scene.toml,\n95 % intervals", False),
    "report": (10.0, 2.3, "report", True),
    "page": (11.7, 2.3, "report.html\n(any browser)", False),
    "picture": (10.0, 1.15, "picture,\nanimate", True),
    "images": (11.7, 1.15, ".png, .pdf\n.webp, .gif", False),
    "export": (10.0, 0.0, "export", True),
    "fibres": (11.7, 0.0, "fibres for FEBio,\nAbaqus, ParaView", False),
}  # fmt: skip
WIDE, NARROW, HIGH = 1.75, 1.35, 0.72
ARROWS = (
    ("scan", "wall"), ("wall", "mesh"), ("mesh", "scene"), ("numbers", "scene"), ("scene", "run"), ("run", "folder"),
    ("data", "fit"), ("scene", "fit"), ("fit", "bands"), ("folder", "report"), ("folder", "picture"),
    ("folder", "export"), ("report", "page"), ("picture", "images"), ("export", "fibres"),
)  # fmt: skip


def ends_of(first: str, second: str) -> Iterator[tuple[float, float]]:
    """Yield where the arrow between two boxes starts and ends."""
    (x, y, _, command), (to_x, to_y, _, to_command) = BOXES[first], BOXES[second]
    width, to_width = NARROW if command else WIDE, NARROW if to_command else WIDE
    if x == to_x:
        yield x + width / 2, y
        yield to_x + to_width / 2, to_y + HIGH
    else:
        yield x + width, y + HIGH / 2
        yield to_x, to_y + HIGH / 2


def workflow() -> Figure:
    """Draw files and commands from left to right."""
    figure = Figure(figsize=(7.4, 1.9))
    axes = figure.add_axes((0.005, 0.01, 0.99, 0.98))
    axes.set_axis_off()
    for x, y, text, command in BOXES.values():
        looks = {"fc": BLUE, "ec": BLUE} if command else {"fc": "white", "ec": "0.3"}
        width = NARROW if command else WIDE
        axes.add_patch(
            FancyBboxPatch(
                (x, y), width, HIGH, boxstyle="round,pad=0,rounding_size=0.12", lw=0.9, **looks
            )
        )
        axes.text(x + width / 2, y + HIGH / 2, text, ha="center", va="center", fontsize=6.3,
                  color="white" if command else "black", weight="bold" if command else "normal")  # fmt: skip
    for pair in ARROWS:
        arrow(axes, *ends_of(*pair), lw=0.9, color="0.3")
    arrow(axes, (8.3, HIGH), (7.1, 1.15), lw=0.9, color="0.3")  # what was fitted is run
    axes.set(xlim=(-0.1, 13.55), ylim=(-0.15, 3.15))
    return figure


def make(keep: bool) -> None:
    """Draw the three; there is nothing to keep."""
    source = "docs/making/schematics.py"
    for name, about, draw in (
        ("cell", CELL, cell),
        ("tube", TUBE, tube),
        ("workflow", WORKFLOW, workflow),
    ):
        drawn(Page(FIGURES, name, *about), draw, made=source, **{"axes.grid": False})
