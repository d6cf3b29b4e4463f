"""The body of a run in PyVista: a grid with its fields, and a plotter with the colours and chains of all pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.pictures.bodies import OF_RIBBONS, DrawnBody, chains, outer_faces, scale
from remodel_fenicsx.pictures.rendering import add_patches
from remodel_fenicsx.pictures.sight import Viewing, shown_elements
from remodel_fenicsx.results.drawing import AMBIENT, LEVELS
from remodel_fenicsx.results.recording import RecordedRun, RecordingError
from remodel_fenicsx.results.whole_body import WholeBody, has_a_body

if TYPE_CHECKING:
    import pyvista

ANGLES = ("fibre_angle", "fibre_angle_deformed")  # fields in degrees, from 0 to 90


def grid(recording: RecordedRun, time: float) -> pyvista.UnstructuredGrid:
    """The whole reference body with the fields of a recorded time; parameters and errors as of `Recording.grid`."""
    whole = _whole(recording)
    return _grid(whole, time, np.ones(len(whole.elements), dtype=bool))


def plot(
    recording: RecordedRun, time: float, name: str, viewing: Viewing, with_chains: bool,
    plotter: pyvista.Plotter | None, options: dict[str, Any],
) -> pyvista.Plotter:  # fmt: skip
    """Put a body into a plotter; parameters and errors as of `Recording.plot`."""
    import pyvista

    whole = _whole(recording)
    shown = shown_elements(whole, viewing)
    found = _grid(whole, time, shown)
    if name not in found.cell_data:
        raise RecordingError(f"{recording.path}: no field {name!r} of elements; there are {', '.join(found.cell_data)}")
    if plotter is None:
        plotter = pyvista.Plotter(lighting="none")
        plotter.background_color = "white"
        plotter.add_light(pyvista.Light(light_type="headlight", intensity=1.0))
    is_deformed = "displacement" in found.point_data
    body = found.warp_by_vector("displacement") if is_deformed else found
    plotter.add_mesh(body, **{**_looks(name), **options})
    snapshot = DrawnBody.at(whole, time)
    if with_chains and is_deformed and set(OF_RIBBONS) <= set(snapshot.fields):
        faces, elements, _ = outer_faces(snapshot, shown)
        add_patches(plotter, [chains(snapshot, faces, elements)], None)
    return plotter


def _looks(name: str) -> dict[str, Any]:
    """How `add_mesh` draws a body that is coloured by this field."""
    found = {"scalars": name, "show_edges": True, "edge_color": "#777777", "ambient": AMBIENT, "diffuse": 1 - AMBIENT}
    if name in ANGLES:
        found |= {"cmap": scale()[0], "clim": (0.0, 90.0), "n_colors": LEVELS}
    return found


def _whole(recording: RecordedRun) -> WholeBody:
    if not has_a_body(recording):
        raise RecordingError(f"{recording.path}: the run recorded no fields of a body (output.fields)")
    return WholeBody(recording)


def _grid(whole: WholeBody, time: float, shown: NDArray[np.bool_]) -> pyvista.UnstructuredGrid:
    """Of the elements that are shown."""
    import pyvista

    displacement, fields = whole.fields(time)
    kind = {8: pyvista.CellType.HEXAHEDRON, 4: pyvista.CellType.TETRA}[whole.elements.shape[1]]
    found = pyvista.UnstructuredGrid({kind: whole.elements[shown]}, whole.points)
    if displacement is not None:
        found.point_data["displacement"] = displacement
    for name, values in {"layer": whole.layer, **fields}.items():
        found.cell_data[name] = values[shown]
    return found
