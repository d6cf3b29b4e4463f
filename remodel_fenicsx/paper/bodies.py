"""Bodies at a time of a recording, and in pictures: elements by their fibre angle, with the chains on the surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from remodel_fenicsx.paper.rendering import Patch, Pixels
from remodel_fenicsx.results.chain_lines import chain_lines
from remodel_fenicsx.results.drawing import (
    AMBIENT,
    ANGLE_COLOURS,
    CHAIN_COLOUR,
    CHAIN_LIFT,
    CHAIN_REACH,
    CHAIN_ROOM,
    CHAIN_WIDTH,
    LEVELS,
)
from remodel_fenicsx.results.recording import Recording

Array = NDArray[np.float64]
Table = dict[str, NDArray[Any]]  # columns by name, all of one length
Shown = NDArray[np.bool_] | slice  # which elements
ALL = slice(None)

# faces of VTK's hexahedron, by its local nodes
_FACES = np.array([(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)])


@dataclass(frozen=True)
class DrawnBody:
    """A body of hexahedra at one time.

    Attributes
    ----------
    time
    points, displacement
        Reference coordinates and displacements of the nodes, (nodes, 3).
    elements
        Nodes of the elements in VTK's order, (elements, 8).
    fields
        Means over the elements, by name (docs/commands.md): (elements,) or (elements, n).
    """

    time: float
    points: Array
    elements: NDArray[np.int64]
    displacement: Array
    fields: dict[str, Array]

    @classmethod
    def of(cls, run: Recording, time: float) -> DrawnBody:
        """The solved state of a run at a recorded time.

        Raises
        ------
        RecordingError
            If there is none.
        """
        fields = run.fields(time)
        return cls(time, run.points, run.elements, fields.pop("displacement"), fields)

    @property
    def centres(self) -> Array:
        """Reference centres of the elements, (elements, 3)."""
        return self.points[self.elements].mean(axis=1)

    @property
    def deformed(self) -> Array:
        """Deformed coordinates of the nodes, (nodes, 3)."""
        return self.points + self.displacement

    def exterior(self, shown: Shown = ALL) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Faces of the shown elements that no other shown element covers: nodes (m, 4), elements (m,)."""
        elements = np.arange(len(self.elements))[shown]
        faces = self.elements[elements][:, _FACES].reshape(-1, 4)
        _, number, count = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
        alone = count[np.ravel(number)] == 1
        return faces[alone], np.repeat(elements, len(_FACES))[alone]


def rank_of(values: Array) -> NDArray[np.int64]:
    """Number of each value among the distinct ones, ascending, from 0: layers, rows or columns of a regular mesh."""
    ordered = np.sort(values)
    starts = np.concatenate([[True], np.diff(ordered) > 1e-6 * (ordered[-1] - ordered[0])])
    return np.searchsorted(ordered[starts], values + 1e-7 * (ordered[-1] - ordered[0])) - 1


def radii(points: Array, elements: NDArray[np.int64]) -> Array:
    """Mean distance of each element's nodes from the z axis, (elements,)."""
    return np.linalg.norm(points[:, :2], axis=1)[elements].mean(axis=1)


def layers(snapshot: DrawnBody) -> NDArray[np.int64]:
    """Number of each element's layer in the wall of a tube, from the inside, (elements,)."""
    return rank_of(radii(snapshot.points, snapshot.elements))


# ---------------------------------------------------------------- pictures


def scale() -> tuple[Colormap, BoundaryNorm]:
    """Colours from red (0 degrees, aligned) over yellow to blue (90 degrees, orthogonal), in equal steps."""
    return ListedColormap(ANGLE_COLOURS), BoundaryNorm(np.linspace(0.0, 90.0, LEVELS + 1), LEVELS, clip=True)


def coloured(angle: Array) -> Array:
    """Colours (m, 3) of angles in degrees (m,)."""
    colours, steps = scale()
    return colours(steps(angle))[:, :3]


def scale_colours() -> Array:
    """Every colour of the scale, also as a face shows it that is turned away from the eye, (n, 3) in 0..1."""
    middle = (np.arange(LEVELS) + 0.5) * (90.0 / LEVELS)
    return np.concatenate([share * coloured(middle) for share in np.linspace(1.0, AMBIENT, 5)])


def body(snapshot: DrawnBody, shown: Shown = ALL) -> list[Patch]:
    """The surface of the shown elements in the deformed configuration, and chains where it looks away from the z axis.

    Parameters
    ----------
    snapshot
        The body.
    shown
        Which elements, (elements,).
    """
    faces, elements = snapshot.exterior(shown)
    angle = snapshot.fields["fibre_angle_deformed"][elements]
    centres, outward = snapshot.points[faces].mean(axis=1), _normals(snapshot.points[faces])
    outward *= np.sign(np.sum(outward * (centres - snapshot.centres[elements]), axis=1))[:, None]
    away = np.sum(outward[:, :2] * centres[:, :2], axis=1) > 0.5 * np.linalg.norm(centres[:, :2], axis=1)
    surface = Patch(snapshot.deformed[faces], coloured(angle), edges=True)
    return [surface, chains(snapshot, faces[away], elements[away])]


def chains(snapshot: DrawnBody, faces: NDArray[np.int64], elements: NDArray[np.int64]) -> Patch:
    """The four chains of each element, deformed, projected on one of its faces: narrow ribbons.

    They stay in their face and clear of its edge, so that those of neighbours do not read as one line.

    Parameters
    ----------
    snapshot
        The body.
    faces
        Nodes of the faces, (m, 4).
    elements
        The element of each, (m,).
    """
    fields, reference, deformed = snapshot.fields, snapshot.points[faces], snapshot.deformed[faces]
    centres, middle = reference.mean(axis=1), deformed.mean(axis=1)
    axes = np.stack([fields[f"axis_{i + 1}"][elements] for i in range(3)], axis=1)
    gradient = fields["deformation_gradient"][elements].reshape(-1, 3, 3)
    size = np.linalg.norm(reference - np.roll(reference, 1, axis=1), axis=2).min(axis=1)
    ends, _ = chain_lines(np.zeros_like(centres), fields["cell_dimensions"][elements], axes, 1.0)
    half = CHAIN_REACH * size[:, None, None] * ends.reshape(-1, 8, 3)[:, ::2]  # (m, 4, 3): one half of each chain
    outward = _normals(deformed)
    inner = np.einsum("mij,mj->mi", gradient, snapshot.centres[elements] - centres)
    outward *= -np.sign(np.sum(outward * inner, axis=1))[:, None]
    arms = _on_plane(half @ np.swapaxes(gradient, 1, 2), outward)
    arms *= np.minimum(1.0, CHAIN_ROOM * _room(arms, _on_plane(deformed - middle[:, None], outward), outward))[
        ..., None
    ]
    across = np.cross(outward[:, None], arms)
    length = np.linalg.norm(across, axis=-1, keepdims=True)
    across *= (CHAIN_WIDTH / 2 * size)[:, None, None] / np.where(length > 0, length, 1.0)
    start, end = middle[:, None] - arms, middle[:, None] + arms
    corners = np.stack([start - across, end - across, end + across, start + across], axis=2).reshape(-1, 4, 3)
    lift = CHAIN_LIFT * float(np.median(size)) if len(size) else 0.0
    return Patch(corners, np.tile(CHAIN_COLOUR, (len(corners), 1)), lies_on=lift)


def _on_plane(vectors: Array, normal: Array) -> Array:
    """Vectors (m, n, 3) without their part along a unit normal (m, 3)."""
    return vectors - np.einsum("mki,mi->mk", vectors, normal)[..., None] * normal[:, None]


def _room(arms: Array, corners: Array, normal: Array) -> Array:
    """Factors (m, n) by which lines from -arm to +arm (m, n, 3) reach the edge of faces about 0, corners (m, 4, 3)."""
    edges = np.roll(corners, -1, axis=1) - corners
    across = np.cross(edges, normal[:, None])
    distance = np.abs(np.sum(across * corners, axis=2))
    towards = np.abs(np.einsum("mei,mki->mke", across, arms))
    return (distance[:, None] / np.where(towards > 0, towards, np.finfo(float).tiny)).min(axis=2)


def _normals(corners: Array) -> Array:
    """Unit normals of quadrilaterals (m, 4, 3)."""
    normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


# ---------------------------------------------------------------- on the page


def place(axes: Axes, image: Pixels) -> None:
    """Put a picture into axes that show nothing else, at their upper edge."""
    axes.imshow(image, interpolation="lanczos")
    axes.set_anchor("N")
    axes.set_axis_off()


def angle_scale(figure: Figure, place_at: tuple[float, float, float, float], label: str) -> None:
    """The scale of all angles: 0 to 90 degrees, red to blue; `label` says from which direction to which."""
    axes = figure.add_axes(place_at)
    colours, steps = scale()
    bar: Any = figure.colorbar(ScalarMappable(steps, colours), cax=axes, orientation="horizontal")
    bar.set_ticks(range(0, 91, 15), labels=[f"{angle}°" for angle in range(0, 91, 15)])
    bar.ax.tick_params(length=2.5, labelsize=8, pad=2)
    bar.outline.set_linewidth(0.5)
    bar.set_label(label, fontsize=8.5, labelpad=2)
