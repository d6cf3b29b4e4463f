"""Make lumen.stl, a surface to try the next steps with: a bent, narrowing, slightly oval lumen, open at both ends.

    ./with-fenicsx python3 demos/own_vessel/lumen.py lumen.stl

In its place take the surface of your own segmentation (3D Slicer, ITK-SNAP, VMTK), cut open at its ends.
"""

from __future__ import annotations

import sys

import meshio
import numpy as np

RADIUS, LENGTH, BEND = 1.8, 14.0, 45.0  # mm at the inlet, mm along the middle, degrees
NARROWING, OVAL = 0.15, 0.05  # shares of the radius
AROUND, ALONG = 32, 40


def main(path: str) -> None:
    """A grid of triangles around an arc, which begins at the origin along z."""
    turn, around = np.meshgrid(
        np.linspace(0, np.radians(BEND), ALONG), 2 * np.pi * np.arange(AROUND) / AROUND
    )
    middle = LENGTH / np.radians(BEND)
    radius = RADIUS * (1 - NARROWING * turn / turn.max()) * (1 + OVAL * np.sin(2 * around))
    across = middle + radius * np.cos(around)
    places = np.stack(
        [across * np.cos(turn) - middle, radius * np.sin(around), across * np.sin(turn)], axis=-1
    )
    number = np.arange(AROUND * ALONG).reshape(AROUND, ALONG)
    a, b = number[:, :-1], np.roll(number, -1, axis=0)[:, :-1]
    c, d = a + 1, b + 1
    triangles = np.concatenate(
        [np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, d), (a, d, c))]
    )
    meshio.Mesh(places.reshape(-1, 3), [("triangle", triangles)]).write(path)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "lumen.stl")
