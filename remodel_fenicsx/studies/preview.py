"""What a scene's body is, looked at before any solve: its local axes on its mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from mpi4py import MPI

from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.results.fields import local_fields
from remodel_fenicsx.results.vtkhdf import vtk_cells
from remodel_fenicsx.results.vtu import write_vtu
from remodel_fenicsx.scene import Scene
from remodel_fenicsx.simulation import build, checked_domain, with_choices


def write_axes(scene: Scene, path: Path, comm: MPI.Intracomm = MPI.COMM_WORLD) -> str:
    """Write local axes, depth, station, thickness, and where the axes are undefined, by element. Collective.

    Parameters
    ----------
    scene
        Whose body it is; of a reduction the part that stands for it.
    path
        A new VTU file.
    comm
        Ranks that share the mesh.

    Returns
    -------
    What was found, in words of one line.

    Raises
    ------
    SceneError, GeometryError
        If the body cannot be meshed or has no local axes.
    FileExistsError
        If the file is there.
    """
    scene = with_choices(scene)
    domain, shape = checked_domain(build(scene, comm), scene), scene.geometry
    mesh = domain.mesh
    weight = KINEMATICS[scene.model.kinematics].on(mesh, shape).weight(mesh)
    quadrature = Quadrature(mesh, scene.mesh.degree, weight)
    local_axes = shape.local_axes(domain, quadrature)
    fields = local_fields(local_axes, quadrature) | {"region": domain.element_region.astype(np.int64)}
    words = [f"{domain.number_of_elements} elements"]
    if local_axes.thickness is not None:
        fields["thickness"] = quadrature.element_mean(local_axes.thickness)
        least, most = quadrature.minimum(local_axes.thickness), quadrature.maximum(local_axes.thickness)
        words.append(f"wall {least:.4g} to {most:.4g} thick")
    if local_axes.undefined is not None:
        undefined = local_axes.undefined.astype(np.float64)
        fields["undefined"] = undefined.max(axis=1)
        words.append(f"axes undefined in {100 * quadrature.mean(undefined):.2g} % of the wall")
    gathered = {name: domain.gather_elements(values) for name, values in fields.items()}
    points, elements = domain.gather_mesh()
    if points is not None and elements is not None:
        cell_type, cells = vtk_cells(mesh.topology.cell_name(), mesh.geometry.cmap.degree, elements)
        write_vtu(path, points, cells, cell_type, {n: v for n, v in gathered.items() if v is not None})
    return "; ".join(words)
