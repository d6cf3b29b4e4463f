"""Bodies at a time of a recording, and in pictures: elements by their fibre angle, with the chains on the surface."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from remodel_fenicsx.pictures.rendering import Patch, Pixels
from remodel_fenicsx.results.chain_lines import AXIS_FIELDS, chain_lines
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
from remodel_fenicsx.results.recording import RecordedRun
from remodel_fenicsx.results.whole_body import WholeBody, rank_of

Array = NDArray[np.float64]
Table = dict[str, NDArray[Any]]  # columns by name, all of one length
Shown = NDArray[np.bool_] | slice  # which elements
ALL = slice(None)

ANGLE = "fibre_angle_deformed"  # by which bodies are coloured
OF_RIBBONS = ("deformation_gradient", "cell_dimensions", *AXIS_FIELDS)  # fields that chains are drawn of
SHOWN_FIELDS = ("displacement", ANGLE, *OF_RIBBONS)
NO_SIDE = 1e-4  # of the longest: such a side is one point of a wedge on an axis, to the digits of the fields
NOTHING_KNOWN = (0.6, 0.62, 0.65)  # where chains have no angle

# faces of VTK's hexahedron and tetrahedron, by their local nodes
_FACES = {
    8: np.array([(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]),
    4: np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)]),
}


@dataclass(frozen=True)
class DrawnBody:
    """A body of hexahedra or tetrahedra at one time.

    Attributes
    ----------
    time
    points, displacement
        Reference coordinates and displacements of the nodes, (nodes, 3).
    elements
        Corners of the elements in VTK's order, (elements, 8 or 4).
    fields
        Means over the elements, by name (docs/commands.md): (elements,) or (elements, n).
    """

    time: float
    points: Array
    elements: NDArray[np.int64]
    displacement: Array
    fields: dict[str, Array]

    @classmethod
    def of(cls, run: RecordedRun, time: float) -> DrawnBody:
        """The solved state of a run at a recorded time.

        Raises
        ------
        RecordingError
            If there is none.
        """
        return cls.at(WholeBody(run), time)

    @classmethod
    def at(cls, whole: WholeBody, time: float, names: Collection[str] | None = None) -> DrawnBody:
        """The same of a body that is looked at several times; without displacements it is the reference body.

        Parameters
        ----------
        whole
            The body.
        time
            As recorded.
        names
            Fields that are read; default: all.

        Raises
        ------
        RecordingError
            If there are none at this time.
        """
        displacement, fields = whole.fields(time, names)
        moved = np.zeros_like(whole.points) if displacement is None else displacement
        return cls(time, whole.points, whole.elements, moved, fields)

    @property
    def centres(self) -> Array:
        """Reference centres of the elements, (elements, 3)."""
        return self.points[self.elements].mean(axis=1)

    @property
    def deformed(self) -> Array:
        """Deformed coordinates of the nodes, (nodes, 3)."""
        return self.points + self.displacement

    def exterior(self, shown: Shown = ALL) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Faces of the shown elements that no other shown element covers: nodes (m, 4 or 3), elements (m,)."""
        elements, of_one = np.arange(len(self.elements))[shown], _FACES[self.elements.shape[1]]
        faces = self.elements[elements][:, of_one].reshape(-1, of_one.shape[1])
        _, number, count = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
        alone = count[np.ravel(number)] == 1
        return faces[alone], np.repeat(elements, len(of_one))[alone]


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
    """Colours (m, 3) of angles in degrees (m,); NaN is grey."""
    colours, steps = scale()
    return np.where(np.isnan(angle)[:, None], NOTHING_KNOWN, colours(steps(np.nan_to_num(angle)))[:, :3])


def scale_colours() -> Array:
    """Every colour of the scale, also as a face shows it that is turned away from the eye, (n, 3) in 0..1."""
    middle = (np.arange(LEVELS) + 0.5) * (90.0 / LEVELS)
    return np.concatenate([share * coloured(middle) for share in np.linspace(1.0, AMBIENT, 5)])


def body(snapshot: DrawnBody, shown: Shown = ALL, chains_everywhere: bool = False) -> list[Patch]:
    """The surface of the shown elements in the deformed configuration, and chains on its faces.

    Parameters
    ----------
    snapshot
        The body.
    shown
        Which elements, (elements,).
    chains_everywhere
        On all faces, where cells were recorded; else on those that look away from the z axis.
    """
    faces, elements, normal = outer_faces(snapshot, shown)
    surface = Patch(snapshot.deformed[faces], coloured(snapshot.fields[ANGLE][elements]), edges=True)
    if not set(OF_RIBBONS) <= set(snapshot.fields):
        return [surface]
    if not chains_everywhere:
        centres = snapshot.points[faces].mean(axis=1)
        normal *= np.sign(np.sum(normal * (centres - snapshot.centres[elements]), axis=1))[:, None]
        away = np.sum(normal[:, :2] * centres[:, :2], axis=1) > 0.5 * np.linalg.norm(centres[:, :2], axis=1)
        faces, elements = faces[away], elements[away]
    return [surface, chains(snapshot, faces, elements)]


def outer_faces(snapshot: DrawnBody, shown: Shown = ALL) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Faces that are seen: nodes (m, 4 or 3), elements (m,), unit normals in the reference body (m, 3)."""
    faces, elements = snapshot.exterior(shown)
    normal = _normals(snapshot.points[faces])
    has_area = np.any(normal, axis=1)  # wedges on an axis are hexahedra with a face of no area
    return faces[has_area], elements[has_area], normal[has_area]


def chains(snapshot: DrawnBody, faces: NDArray[np.int64], elements: NDArray[np.int64]) -> Patch:
    """The four chains of each element, deformed, projected on one of its faces: narrow ribbons.

    They stay in their face and clear of its edge, so that those of neighbours do not read as one line.

    Parameters
    ----------
    snapshot
        The body.
    faces
        Nodes of the faces, (m, 4 or 3).
    elements
        The element of each, (m,).
    """
    fields, reference, deformed = snapshot.fields, snapshot.points[faces], snapshot.deformed[faces]
    centres, middle = reference.mean(axis=1), deformed.mean(axis=1)
    axes = np.stack([fields[f"axis_{i + 1}"][elements] for i in range(3)], axis=1)
    gradient = fields["deformation_gradient"][elements].reshape(-1, 3, 3)
    sides = np.linalg.norm(reference - np.roll(reference, 1, axis=1), axis=2)
    size = np.where(sides > 0, sides, np.inf).min(axis=1)  # of a wedge one side has no length
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
    """Factors (m, n) by which lines from -arm to +arm (m, n, 3) reach the edge of faces about 0, corners (m, k, 3)."""
    edges = np.roll(corners, -1, axis=1) - corners
    across = np.cross(edges, normal[:, None])
    distance = np.abs(np.sum(across * corners, axis=2))
    towards = np.abs(np.einsum("mei,mki->mke", across, arms))
    reach = distance[:, None] / np.where(towards > 0, towards, np.finfo(float).tiny)
    length = np.linalg.norm(edges, axis=2)
    is_side = length > NO_SIDE * length.max(axis=1, keepdims=True)
    return np.where(is_side[:, None], reach, np.inf).min(axis=2)


def _normals(corners: Array) -> Array:
    """Unit normals of quadrilaterals (m, 4, 3) or triangles (m, 3, 3); 0 where they have no area."""
    last = corners.shape[1] - 1
    normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, last] - corners[:, 1])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return normal / np.where(length > 0, length, 1.0)


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
