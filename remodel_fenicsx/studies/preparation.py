"""What may be looked at before any solve: the scene of an unloaded body, and local axes on the mesh."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from mpi4py import MPI

from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.results.export import write_vtu
from remodel_fenicsx.results.fields import local_fields
from remodel_fenicsx.results.vtkhdf import vtk_cells
from remodel_fenicsx.running import with_files_kept
from remodel_fenicsx.scene import Scene
from remodel_fenicsx.simulation import checked_domain, mesh_of, with_choices
from remodel_fenicsx.system.files import TakenError, part_of, temporary_folder
from remodel_fenicsx.unloading import unloaded


def write_unloaded(scene: Scene, folder: Path) -> str:
    """Write scene.toml of the unloaded body into a new folder, with unloaded.msh of an own one; say what was found."""
    if folder.exists():
        raise TakenError(folder, "folder")
    with temporary_folder() as temporary:
        found = unloaded(scene, MPI.COMM_SELF, temporary)
        kept, files = with_files_kept(found)
        part = part_of(folder)
        shutil.rmtree(part, ignore_errors=True)  # of one that was killed
        part.mkdir(parents=True)
        for name, data in files.items():
            (part / name).write_bytes(data)
        (part / "scene.toml").write_text(kept.to_toml(f"the unloaded body of {scene.name}"), encoding="utf-8")
        part.rename(folder)
        return "unloaded: " + _in_words(scene, found)


def _in_words(scene: Scene, found: Scene) -> str:
    numbers = found.geometry.model_dump()
    lengths = {name: value for name, value in numbers.items() if isinstance(value, float)}
    known = scene.geometry.model_dump()
    words = [f"{name} {value:.6g} (loaded {known[name]:.6g})" for name, value in lengths.items()]
    if words:
        return ", ".join(words)
    before, after = (one.geometry.checked(one.mesh)[0].points for one in (scene, found))  # type: ignore[attr-defined]
    return f"{len(after)} nodes, moved by {np.linalg.norm(after - before, axis=1).max():.6g} at most"


def write_axes(scene: Scene, path: Path, comm: MPI.Intracomm = MPI.COMM_WORLD) -> str:
    """Write local axes, depth, station, thickness, and where the axes are undefined, by element. Collective."""
    scene = with_choices(scene)
    domain, shape = checked_domain(mesh_of(scene, comm), scene), scene.geometry
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
