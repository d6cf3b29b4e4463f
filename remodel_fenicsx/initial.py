"""Initial state of a body: kinematics, formulation, mesh, fibre files and unloaded states."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.body.loading import Loading
from remodel_fenicsx.body.reductions import AUTO, choice, describe_choice, only_for_means
from remodel_fenicsx.body.wall import RoundWall
from remodel_fenicsx.errors import UnreadableFile
from remodel_fenicsx.fem.assembly import raise_on_all_ranks
from remodel_fenicsx.fem.formulations import FORMULATIONS
from remodel_fenicsx.fem.kinematics import WITH_NUMBERS, NaturalConfiguration
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.model.axes import GROWTH, NATURAL_GRADIENT, LocalAxes
from remodel_fenicsx.model.tensors import Array, Flags, stretch_tensor
from remodel_fenicsx.scene import Scene, SceneError
from remodel_fenicsx.schema.settings import Cells, in_region
from remodel_fenicsx.state import State, UnitCells
from remodel_fenicsx.system.files import command_name

if TYPE_CHECKING:
    from dolfinx.fem import Function
    from numpy.typing import ArrayLike

    from remodel_fenicsx.body.fibres import FibreFile
    from remodel_fenicsx.model.residual_stress import ClosedRing

log = logging.getLogger(__name__)

# measured fibres by region and name, with a row for each element of the mesh
Fibres = Mapping[str, Mapping[str, Array]]
# Fields of a fibre file that continue an earlier run, with their values at the start of a new run.
INITIAL_VALUES: Mapping[str, ArrayLike] = {
    NATURAL_GRADIENT: np.eye(3),
    "content": 1.0,
    "natural_length": 1.0,
    GROWTH: 1.0,
}
NO_FIBRES: Fibres = {}
MAX_EXTRAPOLATION = 0.5
"""Largest extrapolation of the closing's polynomials, in widths of the innermost layer.

At points farther inside a thin wall the stretches are rounding errors: polynomials of degree 24
grow by T_24(1 + 2 MAX_EXTRAPOLATION) = 3e13 up to there.
"""
ELEMENTS_OF_A_LOOK, LARGEST_LOOK = 10**5, 10**8
"""Elements of a body and bytes of a fibre file that `validate` checks in a few seconds."""


def meshed(scene: Scene, comm: MPI.Intracomm, domain: Domain | None) -> tuple[Scene, Domain]:
    """Resolve and log the scene's choices; return the resolved scene and its mesh. Collective."""
    if scene.geometry.is_loaded:
        raise SceneError(
            f"geometry.is = 'loaded': needs the unloaded body, from {command_name()} unload SCENE"
        )
    if domain is None and comm.rank == 0:
        for line in (
            describe_choice(scene) if scene.model.kinematics == AUTO else only_for_means(scene)
        ):
            log.info("%s", line)
    if scene.mesh.formulation == AUTO:
        log.info("%s", scene.describe_formulation())
    scene = resolve_auto_settings(scene, domain)
    return scene, checked_domain(mesh_of(scene, comm) if domain is None else domain, scene)


def initial_states(scene: Scene, domain: Domain, fibres: Fibres) -> list[State]:
    """Make the unloaded state of each load case, all with the same compiled kernels."""
    made = [make_kinematics(scene, domain) for _ in scene.each_case()]
    unknowns = [one.unknown(domain.mesh, scene.mesh.degree) for one in made]
    quadrature = Quadrature(domain.mesh, scene.mesh.degree, made[0].weight(domain.mesh))
    properties, local_axes = scene.properties(), scene.geometry.local_axes(domain, quadrature)
    own = {name: properties[name].cells for name in scene.regions}
    grows = bool(scene.remodeling.growth_key)
    if grows or not scene.is_stress_free:
        values, closed = np.eye(3), None
        if not scene.is_stress_free:
            values, closed = natural_gradient(scene, quadrature, domain, local_axes, fibres)
        present, initial = (
            quadrature.function(f"{name}_gradient", (3, 3)) for name in ("natural", "initial")
        )
        for function in (present, initial):
            quadrature.values(function, (3, 3))[:] = values
        made = [
            NaturalConfiguration(one, present, closed, initial if grows else None) for one in made
        ]
    cells = UnitCells(quadrature, domain, scene.cells, local_axes, own, fibres)
    return [make_state(scene, u, k, cells, domain) for u, k in zip(unknowns, made, strict=True)]


def make_kinematics(scene: Scene, domain: Domain) -> Any:
    """Return the scene's kinematics on a stress-free mesh."""
    kinematics = scene.kinematics.for_mesh(domain.mesh, scene.geometry)
    wrapper = WITH_NUMBERS.get((scene.has_free_length, scene.has_unknown_pressure))
    if wrapper is None:
        return kinematics
    return wrapper(kinematics, scene.geometry, _largest_modulus(scene) / domain.size)


def _largest_modulus(scene: Scene) -> float:
    """Return lambda + 2 mu of the stiffest matrix in the body."""
    matrices = [one.material for one in scene.properties().values()]
    return max(material.lame_lambda + 2 * material.lame_mu for material in matrices)


def make_state(
    scene: Scene,
    unknown: Function,
    kinematics: Any,
    cells: UnitCells,
    domain: Domain,
) -> State:
    """Make the state of a body with its supports and zero loads."""
    shape, loading = scene.geometry, Loading(domain, unknown, kinematics)
    shape.support(loading, scene.supports.ends, scene.loads)
    shape.hold_faces(loading, scene.supports.faces, _largest_modulus(scene), scene.loads)
    return State(unknown, kinematics, cells, loading, FORMULATIONS[scene.mesh.formulation])


def natural_gradient(
    scene: Scene,
    quadrature: Quadrature,
    domain: Domain,
    local_axes: LocalAxes,
    fibres: Fibres = NO_FIBRES,
) -> tuple[Array, ClosedRing | None]:
    """Return G of the natural configuration (elements, points, 3, 3); the closed ring or None."""
    from remodel_fenicsx.body.wall import prestretch
    from remodel_fenicsx.model.residual_stress import close_ring, fresh_stretches

    natural, shape = scene.natural, scene.geometry
    ring = None
    if natural.fibres:
        present, ratio = (
            field_from_files(fibres, name, quadrature, domain)
            for name in (NATURAL_GRADIENT, GROWTH)
        )
        across = np.einsum("...j,...k->...jk", *(2 * [local_axes.axes[..., 2, :]]))
        # G_0 of `evolution.turnover`
        return present @ (np.eye(3) + (ratio - 1.0)[..., None, None] * across), None
    for index, layer in enumerate(natural.layers):
        if layer.region is not None and layer.region not in domain.regions:
            known = ", ".join(map(repr, domain.regions))
            raise SceneError(
                f"natural.layers[{index}].region = {layer.region!r}: no such region; "
                f"there are {known}"
            )
    if isinstance(shape, RoundWall):
        tissues = {name: properties.tissue for name, properties in scene.properties().items()}
        layers = shape.layers_of_tissue(natural, scene.regions, tissues)
        try:
            ring = close_ring(layers, natural.opening_angle)
        except ArithmeticError as error:
            angle = f"natural.opening_angle = {natural.opening_angle:g}"
            raise SceneError(
                f"{angle}: must be smaller, or the stretches of natural.layers nearer to 1: {error}"
            ) from error
        radii = np.linalg.norm(local_axes.coordinates[..., :2], axis=-1)
        inner, outer, *_ = ring.panels.edges
        stretches = ring.stretches(radii)
        beyond = quadrature.maximum(((inner - radii) / (outer - inner)).reshape(quadrature.shape))
        if (
            beyond > MAX_EXTRAPOLATION
            or quadrature.minimum(stretches.min(axis=-1).reshape(quadrature.shape)) <= 0
        ):
            rule = (
                "must be smaller, or mesh.refinement larger: straight element sides leave the wall"
            )
            raise SceneError(f"natural.opening_angle = {natural.opening_angle:g}: {rule}")
    else:
        stretches = prestretch(natural, local_axes, domain)
        fresh = np.ones_like(stretches)
        for name, properties in scene.properties().items():
            chosen = domain.element_region == domain.regions[name] if name else slice(None)
            tissue = replace(properties.tissue, elastin_axes=shape.directions)
            fresh[chosen] = fresh_stretches(tissue)
        stretches *= fresh
    return stretch_tensor(stretches, local_axes.axes).reshape(*quadrature.shape, 3, 3), ring


def check_files(scene: Scene) -> str:
    """Check a scene's files on one rank; describe those that are too large to check here."""
    large = []
    for name, cells in scene.measured_cells.items():
        file = Path(str(cells.fibres))
        if file.is_file() and file.stat().st_size > LARGEST_LOOK:
            large.append(f"{in_region(name)}cells.fibres (over {LARGEST_LOOK / 1e6:g} MB)")
        else:
            read_fibres(cells, name)
    number = scene.geometry.number_of_elements * scene.mesh.refinement**3
    if large or number > ELEMENTS_OF_A_LOOK:
        return f"{', '.join([*large, f'how files fit the body of {number} elements'])}; a run does"
    scene = resolve_auto_settings(scene)
    domain = checked_domain(mesh_of(scene, MPI.COMM_SELF), scene)
    scene.geometry.check_faces(domain, scene.supports.faces, scene.loads)
    measured_fibres(scene, domain)
    return ""


def resolve_auto_settings(scene: Scene, domain: Domain | None = None) -> Scene:
    """Replace "auto" in a scene by its kinematics and formulation. A user-supplied mesh is full."""
    if AUTO not in (scene.model.kinematics, scene.mesh.formulation):
        return scene
    name = choice(scene).name if domain is None or scene.model.kinematics != AUTO else "full"
    return scene.with_values({"model.kinematics": name, "mesh.formulation": scene.formulation})


def mesh_of(scene: Scene, comm: MPI.Intracomm) -> Domain:
    """Return the mesh of a scene: of its body, or of a reduction's part of the body. Collective."""
    if scene.kinematics.reduced:
        return scene.geometry.reductions[scene.model.kinematics].build(scene, comm)
    return scene.geometry.build_with(scene.regions, scene.mesh, comm)


def checked_domain(domain: Domain, scene: Scene) -> Domain:
    """Return the domain if it is a mesh of the scene's body and elements; raise otherwise."""
    shape, mesh = scene.geometry, domain.mesh
    kind, degree = mesh.topology.cell_name(), mesh.geometry.cmap.degree
    if domain.shape != shape.name:
        raise SceneError(f"geometry.shape = {shape.name!r}: the mesh is a {domain.shape!r}")
    element = scene.kinematics.element(scene.mesh.element)
    if kind != element:
        raise SceneError(
            f"mesh.element = {scene.mesh.element!r}: the mesh has elements of type {kind!r}"
        )
    if degree != scene.mesh.degree:
        raise SceneError(f"mesh.degree = {scene.mesh.degree}: the mesh has degree {degree}")
    for name in scene.regions:
        if name not in domain.regions:
            raise SceneError(
                f"regions.{name}: the mesh has no such region; it has {', '.join(domain.regions)}"
            )
    if (
        isinstance(shape, RoundWall)
        and scene.regions
        and (others := set(domain.regions) - set(scene.regions))
    ):
        raise SceneError(f"regions.{min(others)}: missing; it is a region of the mesh")
    needed = () if scene.kinematics.reduced else shape.face_names
    missing = [face for face in needed if face not in domain.faces]
    if missing:
        raise SceneError(
            f"geometry.shape = {shape.name!r}: the mesh has no face {', '.join(missing)}"
        )
    for name, value in domain.dimensions.items():
        wanted = getattr(shape, name, value)
        if not abs(wanted - value) <= 1e-9 * abs(wanted):  # NaN too
            raise SceneError(f"geometry.{name} = {wanted:g}: the mesh has {value:g}")
    empty = [
        name
        for name in needed
        if not domain.comm.allreduce(domain.facet_tags.find(domain.faces[name]).size)
    ]
    if empty:
        raise SceneError(
            f"geometry.shape = {shape.name!r}: the mesh has no facets with the tag of "
            f"{', '.join(empty)}"
        )
    if not domain.comm.allreduce(bool(np.isfinite(mesh.geometry.x).all()), MPI.LAND):
        raise SceneError(f"geometry.shape = {shape.name!r}: the mesh has nodes that are not finite")
    return domain


# ---------------------------------------------------------------- fibre files
# From the files that a scene names to the points of a mesh: measured fibres, and fields that
# continue an earlier run.


def measured_fibres(scene: Scene, domain: Domain) -> dict[str, dict[str, Array]]:
    """Return measured fibres by region and name, with a row for each element. Collective."""
    if not scene.measured_cells:
        return {}
    points, elements = domain.gather_mesh()
    regions = domain.gather_elements(domain.element_region)

    def read() -> dict[str, dict[str, Array]] | None:
        if points is None or elements is None or regions is None:
            return None
        fields = {}
        for name, cells in scene.measured_cells.items():
            chosen = (
                regions == domain.regions[name] if name else np.ones(len(regions), dtype=np.bool_)
            )
            measured = _fibres_of(cells, name, points[elements], chosen)
            fields[name] = _with_prestretch(
                measured, f"{in_region(name)}cells.fibres = {cells.fibres!r}", scene
            )
        return fields

    return domain.comm.bcast(raise_on_all_ranks(domain.comm, read)) or {}


def _with_prestretch(measured: dict[str, Array], key: str, scene: Scene) -> dict[str, Array]:
    """Select the fields of a fibre file that the scene starts with (natural.fibres)."""
    wanted, held = scene.natural.fibres, [name for name in INITIAL_VALUES if name in measured]
    changed = [
        name
        for name in held
        if not np.allclose(measured[name], np.reshape(INITIAL_VALUES[name], -1))
    ]
    if changed and wanted is None:
        rule = "set natural.fibres = true to start with them, or false to ignore them"
        raise SceneError(f"{key}: has {', '.join(changed)} of an earlier run; {rule}")
    for process in scene.remodeling.processes:
        problem = process.initial_problem({name: measured[name] for name in changed})
        if wanted and problem:
            raise SceneError(f"{key}: {problem}")
    return {name: values for name, values in measured.items() if wanted or name not in held}


def read_fibres(cells: Cells, region: str) -> FibreFile:
    from remodel_fenicsx.body.fibres import read_fibre_file  # Few scenes have fibre files.

    try:
        file = read_fibre_file(Path(str(cells.fibres)))
        if cells.fibres_sha256 not in (None, file.sha256):
            raise UnreadableFile(f"has changed: its SHA-256 was {str(cells.fibres_sha256)[:12]}...")
    except UnreadableFile as error:
        raise SceneError(f"{in_region(region)}cells.fibres = {cells.fibres!r}: {error}") from error
    return file


def _fibres_of(cells: Cells, region: str, corners: Array, chosen: Flags) -> dict[str, Array]:
    key, file = f"{in_region(region)}cells.fibres", read_fibres(cells, region)
    try:
        rows, farthest = file.rows_of(corners, chosen)
    except UnreadableFile as error:
        raise SceneError(f"{key} = {cells.fibres!r}: {error}") from error
    count, names = len(next(iter(file.measured.values()))), ", ".join(file.measured)
    way = "by number" if farthest is None else f"by position, at most {farthest:.3g} away"
    log.info("%s: %s read from %d rows %s; SHA-256 %s", key, names, count, way, file.sha256)
    return {name: values[rows] for name, values in file.measured.items()}


def field_from_files(fibres: Fibres, name: str, quadrature: Quadrature, domain: Domain) -> Array:
    """Return a fibre field at the points (elements, points, ...); `INITIAL_VALUES` if absent."""
    plain = np.asarray(INITIAL_VALUES[name])
    field = np.tile(plain, (*quadrature.shape, *(1 for _ in plain.shape)))
    for region, measured in fibres.items():
        if name in measured:
            chosen = (
                domain.element_region == domain.regions[region]
                if region
                else np.ones(len(field), dtype=np.bool_)
            )
            field[chosen] = measured[name][domain.element_number[chosen]].reshape(
                -1, 1, *plain.shape
            )
    return field
