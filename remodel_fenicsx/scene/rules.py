"""Rules across the tables of a scene, in order; the first one that is broken gives the error.

A rule yields (message, key, value) for each fault. The tables check their own keys.
"""

from __future__ import annotations

import math
import re
from collections import Counter

from remodel_fenicsx.body import SHAPES
from remodel_fenicsx.body.box import Sheet
from remodel_fenicsx.body.reductions import AUTO, choice, objections, too_many_elements
from remodel_fenicsx.body.shape import FromFile, Unloads, WithAxes, WithRegions
from remodel_fenicsx.body.wall import RoundWall, Walled
from remodel_fenicsx.fem.formulations import FORMULATIONS
from remodel_fenicsx.fem.solver_methods import SOLVER_METHODS
from remodel_fenicsx.model.chains import CHAINS
from remodel_fenicsx.model.laws import LAWS, MEANS_OF_CASES
from remodel_fenicsx.scene.scene import Scene
from remodel_fenicsx.schema.processes import ProcessTable
from remodel_fenicsx.schema.settings import (
    COUPLINGS,
    EQUILIBRIUM,
    MEASURED_CELLS,
    NAME,
    SUM_OF_WEIGHTS,
    in_region,
    laws_with_a_target,
)
from remodel_fenicsx.schema.tables import Faults, listed, join_names, quoted, format_value


def _shapes(kind: type, mark: str = ", ") -> str:
    """Return the names of the shapes of a kind."""
    return join_names(SHAPES, lambda shape: issubclass(shape, kind)).replace(", ", mark)


def named_regions(scene: Scene) -> Faults:
    """Check that the shape can have regions, and that their names suit column names."""
    shape = scene.geometry
    for name in scene.regions:
        key = f"regions.{quoted(name)}"
        if not isinstance(shape, WithRegions):
            rule = f"a {shape.name} has no regions; shapes with regions: {_shapes(WithRegions)}"
            yield rule, key, None
        if not re.fullmatch(NAME, name):
            rule = "must be a letter, then letters, digits and _, at most 40 in all"
            yield f"the name of a region {rule}", key, None
        columns = [column for column in scene.column_names if column.endswith(f"_{name}")]
        if twice := {column for column in columns if columns.count(column) > 1}:
            yield f"the column {min(twice)!r} already exists; choose another name", key, None


def tissue_of_regions(scene: Scene) -> Faults:
    """Check the keys of regions together with those of the whole body."""
    law = LAWS[scene.remodeling.law]
    for name, (material, cells, kappa) in scene.properties().items():
        region, length = in_region(name), cells.end_to_end_length
        if CHAINS[material.chain].locks and length >= material.contour_length:
            most = f"{region}material.contour_length = {format_value(material.contour_length)}"
            yield f"must be smaller than {most}", f"{region}cells.end_to_end_length", length
        if (words := cells.length_problem()) is not None:
            yield words, f"{region}cells.initial", cells.initial
        if cells.initial == MEASURED_CELLS and cells.fibres is None:
            yield "needs cells.fibres, the name of a file", f"{region}cells.initial", cells.initial
        are_apart = material.has_volumetric_split and scene.material.has_volumetric_split
        if material.matrix != scene.material.matrix and not are_apart:
            rule = f"must be {scene.material.matrix!r}, or both need a volumetric part (Matrix)"
            yield rule, f"{region}material.matrix", material.matrix
        plain = scene.remodeling.speed(scene.remodeling.kappa, material.temperature)
        if kappa != plain and law.remodels and not law.stops_at_zero_kappa:
            rule = f"the law {scene.remodeling.law!r} has no kappa"
            key, value = "remodeling.kappa", kappa
            if not material.chain_density:
                key, value = "material.chain_density", 0.0
                rule = (
                    f"a region without chains must not remodel, but {rule} that could be 0; choose "
                    "another law"
                )
            yield rule, f"{region}{key}", value


def meshed_body(scene: Scene) -> Faults:
    """Check that the shape allows the mesh's sizes and the layers."""
    scene.geometry.check_size(scene.mesh)
    if isinstance(scene.geometry, WithRegions):
        scene.geometry.check_regions(scene.regions, scene.mesh)
    yield from ()


def loads_beside_others(scene: Scene) -> Faults:
    """Check that no two loads exclude each other."""
    for name, load in scene.loads.items():
        if (other := scene.load_kinds[name].replaces) in scene.loads:
            yield f"not allowed together with loads.{other}", f"loads.{name}", load.value


def loaded_body(scene: Scene) -> Faults:
    """Check that the unloaded shape of a loaded geometry can be computed."""
    if not scene.geometry.is_loaded:
        return
    key, value = "geometry.is", "loaded"
    if not isinstance(scene.geometry, Unloads):
        yield f"allowed only for the shapes {_shapes(Unloads)}", key, value
    if scene.has_unknown_pressure:
        yield "not allowed with loads.lumen_expansion: needs the pressure", key, value
    if scene.supports.ends == "clamped":
        yield "not allowed with supports.ends = 'clamped': the loaded radius would vary", key, value
    if measured := ", ".join(f"{in_region(name)}cells.fibres" for name in scene.measured_cells):
        yield f"not allowed with {measured}: it has positions of the loaded geometry", key, value
    if scene.cases:
        rule = (
            "not allowed with [[cases]]: the loaded geometry belongs to one set of loads; run "
            "remodel-fenicsx unload SCENE with these loads and add [[cases]] to its result"
        )
        yield rule, key, value


def same_strain(scene: Scene) -> Faults:
    """Check that loads and cells that need a uniform strain have homogeneous kinematics."""
    angle = scene.cells.mean_angle
    if angle and not (isinstance(scene.geometry, Sheet) and scene.kinematics.homogeneous):
        yield "needs a sheet with model.kinematics = 'point'", "cells.mean_angle", angle
    for name, load in scene.loads.items():
        if scene.load_kinds[name].of_one_strain and not scene.kinematics.homogeneous:
            made = choice(scene)
            reasons = "; ".join(made.objections["point"]) or f"model.kinematics = {made.name!r}"
            rule = f"needs a uniform strain (model.kinematics = 'point'), but {reasons}"
            yield rule, f"loads.{name}.value", load.value


def directions_of_matrices(scene: Scene) -> Faults:
    """Check that the directions of a matrix follow a round wall."""
    if not isinstance(scene.geometry, RoundWall) or not scene.kinematics.three_dimensional:
        return
    for name, properties in scene.properties().items():
        if not properties.tissue.is_round():
            rule = (
                "has directions along x, y and z; only the kinematics 'radial' and 'axisymmetric' "
                "rotate them with the wall (radial, circumferential, axial)"
            )
            yield rule, f"{in_region(name)}material.matrix", properties.material.matrix


def parts_of_the_energy(scene: Scene) -> Faults:
    """Check that a split formulation has a matrix with a volumetric part."""
    name, matrix = scene.mesh.formulation, scene.material.matrix
    if (
        name != AUTO
        and FORMULATIONS[name].splits_energy
        and not scene.material.has_volumetric_split
    ):
        rule = f"needs a material.matrix with a volumetric part (Matrix); {matrix!r} has none"
        yield rule, "mesh.formulation", name


def axes_of_the_shape(scene: Scene) -> Faults:
    """Check that the shape has the axes of the cells."""
    shape, axes = scene.geometry, scene.cells.axes
    if axes not in shape.axis_kinds:
        rule = f"must be {' or '.join(map(repr, shape.axis_kinds))} for shape {shape.name!r}"
        yield rule, "cells.axes", axes


def supports_of_the_shape(scene: Scene) -> Faults:
    """Check that the shape has the supports."""
    shape, ends = scene.geometry, scene.supports.ends
    faces = shape.supported_faces
    if ends not in shape.ends:
        rule = f"must be {' or '.join(map(repr, shape.ends))} for shape {shape.name!r}"
        yield rule, "supports.ends", ends
    if faces is None:
        return
    for name, support in scene.supports.faces.items():
        key = f"supports.{quoted(name)}"
        if name not in faces:
            springs = " or ".join(f"supports.{face} of kind 'elastic'" for face in faces)
            beside = f", or by {springs}" if springs else ""
            yield f"not allowed: a {shape.name} is supported by supports.ends{beside}", key, None
        if support.kind != "elastic":
            yield "must be 'elastic'", f"{key}.kind", support.kind


def cells_of_the_loaded_body(scene: Scene) -> Faults:
    """Check the conditions of natural.cells = "equilibrium"."""
    key, cells = "natural.cells", scene.natural.cells
    shape = scene.geometry
    if cells != "equilibrium":
        return
    if not (shape.is_loaded and isinstance(shape, RoundWall)):
        yield f"needs geometry.is = 'loaded' of the shape {_shapes(RoundWall)}", key, cells
    if not scene.time.is_equilibrium:
        yield "needs time.end = 'equilibrium'", key, cells


def measured_natural_state(scene: Scene) -> Faults:
    """Check the conditions of prestretch from a fibre file."""
    natural, key = scene.natural, "natural.fibres"
    if not natural.fibres:
        return
    if not scene.measured_cells:
        yield "needs cells.fibres, a file that export has written", key, True
    if natural.opening_angle or natural.layers:
        yield "natural.opening_angle or natural.layers is also set; set only one of them", key, True
    if scene.formulation != "displacement":
        yield "must be false unless mesh.formulation is 'displacement'", key, True


def natural_state(scene: Scene) -> Faults:
    """Check that shape, formulation and cells allow residual stress."""
    natural, shape = scene.natural, scene.geometry
    able, none = Walled, "absent"
    if scene.is_stress_free:
        return
    value: object
    key, value = "natural.layers", None
    for name, properties in scene.properties().items():
        if properties.material.has_elastin and (isinstance(shape, Walled) or not natural.layers):
            able = WithAxes
            key, none = f"{in_region(name)}material.elastin.prestretch", "[1.0, 1.0]"
            value = properties.material.elastin.prestretch
            break
    if natural.opening_angle:
        key, value = "natural.opening_angle", natural.opening_angle
        able, none = RoundWall, "0"
    needs = [
        ("geometry.shape", isinstance(shape, able), _shapes(able, " or ")),
        ("mesh.formulation", scene.formulation == "displacement", "'displacement'"),
    ]
    if isinstance(shape, RoundWall):
        needs.append(("cells.axes", scene.cells.axes == "cylindrical", "'cylindrical'"))
    for name, properties in scene.properties().items():
        if isinstance(shape, RoundWall) or properties.material.has_elastin:
            needs.append(
                (
                    f"{in_region(name)}cells.initial",
                    properties.cells.initial == "isotropic",
                    "'isotropic'",
                )
            )
    if natural.fibres:  # the file has cells and G; a prestretch of elastin still needs axes
        needs = needs[:1] if able is WithAxes else []
    for other, has, possible in needs:
        if not has:
            yield f"must be {none} unless {other} is {possible}", key, value


def loads_of_the_body(scene: Scene) -> Faults:
    """Check times of ramps and values of loads, and that a free length is not prescribed."""
    time = scene.time
    for name, load in scene.loads.items():
        key, least = f"loads.{quoted(name)}", scene.load_kinds[name].above
        if (
            name == "elongation"
            and scene.has_free_length
            and any(load.value * factor for _, factor in load.ramp)
        ):
            rule = "must be 0 if the length is an unknown (loads.axial_force or closed ends)"
            yield rule, f"{key}.value", load.value
        for index, (moment, factor) in enumerate(load.ramp):
            if not time.is_equilibrium and moment <= time.end:
                time.check_step_time(moment, f"{key}.ramp[{index}][0]")
            for case in scene.each_case():
                full = case.loads[name].value * factor
                if full <= least:
                    total = full / load.value if load.value else factor
                    rule = (
                        f"must be greater than {least:g} at every time; "
                        f"with the factor {format_value(total)} it is {full:.6g}"
                    )
                    yield rule, f"{key}.value", load.value


def weights_and_factors(scene: Scene) -> Faults:
    """Check that weights of cases sum to 1, and that their factors belong to loads."""
    for index, case in enumerate(scene.cases):
        for name, factor in case.loads.items():
            if name not in scene.loads:
                rule = f"no such load; the scene has {', '.join(scene.loads) or 'none'}"
                yield rule, f"cases[{index}].loads.{quoted(name)}", factor
    total = math.fsum(case.weight for case in scene.cases)
    if scene.cases and abs(total - 1.0) > SUM_OF_WEIGHTS:
        rule = f"the weights of all cases must sum to 1; their sum is {total:.10g}"
        yield rule, f"cases[{len(scene.cases) - 1}].weight", scene.cases[-1].weight


def coupling_and_mean(scene: Scene) -> Faults:
    """Check the conditions of the coupling and of the average over load cases."""
    remodeling, coupling = scene.remodeling, COUPLINGS[scene.remodeling.coupling]
    if missing := coupling.missing and coupling.missing(scene):
        yield f"needs {missing}", "remodeling.coupling", remodeling.coupling
    if remodeling.mean != "tensor" and not scene.cases:
        yield "needs [[cases]]", "remodeling.mean", remodeling.mean
    if MEANS_OF_CASES[remodeling.mean].of_targets and LAWS[remodeling.law].target is None:
        rule = f"needs a remodeling.law with a target: {laws_with_a_target()}"
        yield rule, "remodeling.mean", remodeling.mean
    if scene.cases[1:] and not coupling.takes_cases:
        able = join_names(COUPLINGS, lambda kind: kind.takes_cases)
        yield f"must be one of {able} with [[cases]]", "remodeling.coupling", remodeling.coupling


def additional_processes(scene: Scene) -> Faults:
    """Check that the tissue of all regions has the processes, and that they start in the run."""
    for process in scene.remodeling.processes:
        for region, properties in scene.properties().items():
            if process.is_on:
                yield from process.faults_in(in_region(region), properties.tissue)
        yield from _start_of(scene, process)
        if not process.growth_key:
            continue
        key, value = scene.remodeling.growth_key, getattr(process, process.growth_key)
        if not isinstance(scene.geometry, Walled):
            yield f"must be 0 unless geometry.shape is {_shapes(Walled, ' or ')}", key, value
        if scene.formulation != "displacement":
            yield "must be 0 unless mesh.formulation is 'displacement'", key, value


def _start_of(scene: Scene, process: ProcessTable) -> Faults:
    """Check that a process starts at a time of the run, or at a steady state on the load path."""
    time, key = scene.time, f"remodeling.{process.name}.{process.start_key}"
    if process.starts_at_equilibrium:
        if not time.is_equilibrium:
            yield "needs time.end = 'equilibrium'; otherwise set a time", key, EQUILIBRIUM
        if scene.last_hold is None:
            rule = "needs an interval of constant loads before a further change (loads.NAME.ramp)"
            yield rule, key, EQUILIBRIUM
        if scene.cases:
            yield "needs a scene without [[cases]]", key, EQUILIBRIUM
    for start in process.stops:
        if time.is_equilibrium:
            rule = "time.end = 'equilibrium' has no time axis; set 0 or 'equilibrium'"
            yield rule, key, start
        elif start > time.end:
            yield f"must be at most time.end = {format_value(time.end)}", key, start
        else:
            time.check_step_time(start, key)


def equilibrium(scene: Scene) -> Faults:
    """Check that the cells have a steady state that is independent of the load path."""
    law, parts = scene.remodeling.law, scene.properties().items()
    key, end = "time.end", scene.time.end
    if not scene.time.is_equilibrium:
        return
    if not LAWS[law].has_limit:
        laws = join_names(LAWS, lambda law: law.has_limit)
        rule = f"remodeling.law = {law!r} has no unique steady state; laws with one: {laws}"
        yield rule, key, end
    bare = [
        f"{in_region(name)}material.chain_density"
        for name, one in parts
        if not one.material.chain_density
    ]
    if bare:
        yield f"needs chains: {', '.join(bare)} above 0", key, end
    if still := [f"{in_region(name)}remodeling.kappa" for name, one in parts if one.kappa == 0]:
        yield f"{', '.join(still)} = 0: the cells never change", key, end


def unknown_length(scene: Scene) -> Faults:
    """Check that unknown numbers are solved without multigrid, which cannot include them."""
    method = scene.solver.method
    for unknown, words in (
        (scene.has_free_length, "length is an unknown (loads.axial_force or closed ends)"),
        (scene.has_unknown_pressure, "pressure is an unknown (loads.lumen_expansion)"),
    ):
        if unknown and method == "iterative":
            names = ", ".join(repr(name) for name in (AUTO, *SOLVER_METHODS) if name != method)
            yield f"must be one of {names} if the {words}", "solver.method", method


def times_of_output(scene: Scene) -> Faults:
    """Check that output times are times of steps."""
    for index, moment in enumerate(scene.output.times):
        key = f"output.times[{index}]"
        if scene.time.is_equilibrium:
            yield "not allowed with time.end = 'equilibrium', which has no times", key, moment
        if moment > scene.time.end:
            yield f"must be at most time.end = {format_value(scene.time.end)}", key, moment
        scene.time.check_step_time(moment, key)


def fields_of_the_body(scene: Scene) -> Faults:
    """Check that the body has the output fields."""
    fields = scene.output.fields
    for field, reason in scene.lacking_fields.items():
        if not isinstance(fields, bool) and field in fields:
            yield reason, "output.fields", field


def columns_of_the_history(scene: Scene) -> Faults:
    """Check that the scene has the output columns."""
    shape, key = scene.geometry, "output.columns"
    of_one_tissue = {column.name for column in shape.columns_on_request if column.of_one_tissue}
    for name in scene.output.columns:
        if name == "time_error" and scene.time.is_equilibrium:
            yield f"{name!r} needs time steps; not allowed with time.end = 'equilibrium'", key, name
        if name in of_one_tissue and scene.regions:
            yield f"{name!r} is only for bodies without regions; the scene has regions", key, name
        for process in scene.remodeling.processes:
            if name in process.absent:
                yield process.absent[name], key, name
        if name not in (known := dict.fromkeys(scene.column_names)):
            names = listed(map(repr, known), repr(name))
            yield f"no such column on request; allowed for shape {shape.name!r}: {names}", key, name


def kinematics(scene: Scene) -> Faults:
    """Check that the kinematics can describe the scene's body and loads."""
    name = scene.model.kinematics
    if name != AUTO and (reasons := objections(scene, name)):
        yield "; ".join(reasons), "model.kinematics", name


def number_of_elements(scene: Scene) -> Faults:
    """Check that Gmsh and the memory can handle the number of elements."""
    if not isinstance(scene.geometry, FromFile) and (rule := too_many_elements(scene)):
        yield rule, "mesh.refinement", scene.mesh.refinement


def names_of_columns(scene: Scene) -> Faults:
    """Check that column names are unique."""
    for name, count in Counter(column.name for column in scene.columns()).items():
        if count > 1:
            yield "two columns have this name; rename the custom component", name, None


RULES = (
    named_regions,
    tissue_of_regions,
    meshed_body,
    loads_beside_others,
    loaded_body,
    same_strain,
    directions_of_matrices,
    parts_of_the_energy,
    axes_of_the_shape,
    supports_of_the_shape,
    cells_of_the_loaded_body,
    measured_natural_state,
    natural_state,
    loads_of_the_body,
    weights_and_factors,
    coupling_and_mean,
    additional_processes,
    equilibrium,
    unknown_length,
    times_of_output,
    fields_of_the_body,
    columns_of_the_history,
    kinematics,
    number_of_elements,
    names_of_columns,
)
