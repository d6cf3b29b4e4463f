"""Families on tubes and tendons: locking, axial stretch, suction, buckling, random cells."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.stability_map.cases import (
    MU,
    Case,
    Check,
    Finding,
    Place,
    Run,
    Values,
    named,
    table,
    with_values,
)
from benchmarks.stability_map.homogeneous import CUBE, DRIVERS, FRAMES, RAMP, element, has_frame
from benchmarks.stability_map.judging import SAME_MESH
from tests.reference.march import Wall, load_at, march
from tests.reference.radial import RadialMaterial, Tube
from tests.values import ramped

SOFT = {
    "material.chain_density": 2.0e21,
    "material.contour_length": 1.594,
    "material.persistence_length": 1.365,
}
TUBE = with_values(CUBE, {
    **SOFT, "geometry": {"shape": "tube", "inner_radius": 1.0, "outer_radius": 3.0, "length": 0.5}, "mesh.degree": 2,
    "cells.axes": "cylindrical", "loads": ramped(20.0, pressure=4.8, elongation=0.1), "time.end": 40.0,
    "time.step": 2.0,
})  # fmt: skip
TENDON = with_values(CUBE, {
    **SOFT, "geometry": {"shape": "tendon", "length": 10.0, "area": 10.0}, "cells.initial": "random", "cells.seed": 1,
    "loads": ramped(12.0, force=300.0), "time.end": 40.0,
})  # fmt: skip
COARSE_TENDON = {"tendon": {"AROUND": 8, "CORE": 2, "RINGS": 1, "ALONG": 3}}
RADIUS_TOLERANCE, STEP_TOLERANCE = 0.01, 0.01
ANGLE_TOLERANCE = 1.5  # degrees, of the mean over a body
CELL_TOLERANCE = (
    0.1  # of A over r0^2, root mean square over the elements: a mean may hide that they swing
)
OUTER_ANGLE_TOLERANCE = 5.0  # degrees: a coarse layer of elements
REFERENCE = "tube in one dimension"
FACES, ELEMENTS = ("inner_radius", "outer_radius"), 8  # through the wall, refinement 1


def ring(around: int, through: int) -> dict[str, Any]:
    """Elements around and through the wall, one along."""
    return {"tube": {"PAPER": [around, through, 1]}}


# ---------------------------------------------------------------- the tube in one dimension
def check_wall(case: Case, run: Run) -> Finding:
    """Inner and outer radius of all rows, and angles, held against a staggered march.

    Options of a case: `radii`, their tolerance; `displacement`: in their place the inner one, within this share;
    `angles`: tolerances in degrees by place; `elements` of the reference; `unstable`, what is known of the state.
    """
    wall, options, rows = (
        Wall(case.scene, case.options.get("elements", 60)),
        case.options,
        run.column("time"),
    )
    expected = march(case.scene, wall, coupling="staggered")
    known, whole = options.get("unstable"), not expected.ended
    rows = rows[: np.searchsorted(rows, (expected.times or [0.0])[-1] + 1e-9)]
    if not len(rows):
        return Finding(
            np.inf if run.code == 0 else 0.0, f"no row to compare {expected.ended}", known, whole
        )
    at, radii = expected.at(rows), dict(zip(FACES, expected.faces(), strict=True))
    off = {
        name: np.abs(run.column(name)[: len(rows)] / radii[name][at] - 1).max() for name in FACES
    }
    words = [f"{name} off by {100 * value:.3g} %" for name, value in off.items()]
    ratio = max(off.values()) / options.get("radii", RADIUS_TOLERANCE)
    if "displacement" in options:
        inner, found = wall.tube.inner_radius, run.column("inner_radius")[: len(rows)]
        error = np.abs((found - inner) / (radii["inner_radius"][at] - inner) - 1).max()
        words, ratio = [*words, f"inner displacement off by {100 * error:.3g} %"], error / options[
            "displacement"
        ]
    for place, degrees in options.get("angles", {}).items():
        inside, outside = layer(case, place)
        angles = [expected.mean_angle(wall.tube, inside, outside, row) for row in at]
        angle = np.abs(run.column(f"fibre_angle_{place}")[: len(rows)] - angles).max()
        words, ratio = [*words, f"{place} angle by {angle:.3g} degrees"], max(
            ratio, angle / degrees
        )
    words += [] if whole else [f"the reference ends at t = {expected.times[-1]:g}"]
    return Finding(
        float(np.inf if run.code == 0 and not whole else ratio), ", ".join(words), known, whole
    )


def layer(case: Case, place: str) -> tuple[float, float]:
    """Radii between which the elements of an angle's column are."""
    inner, outer = (case.scene["geometry"][name] for name in FACES)
    through = (
        case.counts["tube"]["PAPER"][1]
        if case.counts
        else ELEMENTS * case.scene["mesh"]["refinement"]
    )
    size, middle = (outer - inner) / through, (inner + outer) / 2
    places = {
        "inner": (inner, inner + size),
        "outer": (outer - size, outer),
        "middle": (middle - size, middle + size),
    }
    return places[place]


def check_inner_displacement(case: Case, run: Run) -> Finding:
    """Displacement of the inner face in every row, elastic."""
    if run.code != 0:
        return Finding(0.0, "not to its end")
    m, geometry = case.scene["material"], case.scene["geometry"]
    elastic = RadialMaterial(m["lame_lambda"], m["lame_mu"], 0.0, 1e9)
    tube = Tube(geometry["inner_radius"], geometry["outer_radius"], 400, elastic)
    radii, cells, errors = tube.nodes.copy(), np.full((len(tube.points), 3), 1 / 3), []
    pressures = [load_at(case.scene, "pressure", time) for time in run.column("time")]
    for before, pressure, found in zip(
        pressures, pressures[1:], run.column("inner_radius")[1:], strict=False
    ):
        for start, end in pairwise(np.linspace(before, pressure, 4)):
            radii = tube.advance(radii, (cells, start, 1.0), (cells, end, 1.0))
        errors.append((found - tube.nodes[0]) / (radii[0] - tube.nodes[0]) - 1)
    error = max(errors, key=abs)
    return Finding(
        abs(error) / case.options["tolerance"], f"inner displacement off by {100 * error:.3g} %"
    )


# ---------------------------------------------------------------- families of tubes
def tube_case(
    family: str, changes: Values, place: Place, check: Check = check_wall, **more: Any
) -> Case:
    """A short piece of the demo's artery with isotropic cells."""
    given = {"counts": ring(8, 4), "options": {"angles": {"outer": OUTER_ANGLE_TOLERANCE}}, **more}
    return Case(
        family, named(family, place), with_values(TUBE, changes), check, REFERENCE, place, **given
    )


def long(around: int = 16, through: int = 8, **options: Any) -> dict[str, Any]:
    """With the error of trilinear elements, 1 % of their own."""
    angles = {"outer": 2 * OUTER_ANGLE_TOLERANCE}
    return {
        "counts": ring(around, through),
        "options": {"radii": 0.02, "angles": angles, **options},
    }


LONG = long()


# larger strains need smaller elements: at 48 the radius is off by 1.3 % on 8, by 0.7 % on 12 of them
table(
    "tube", tube_case,
    {"pressure": (0.0, 0.01, 0.5, 2.4, 4.8, 12.0, 48.0), "stretch": (-0.2, 0.0, 0.1, 0.3, 0.55)},
    reduced=lambda p: (p["pressure"], p["stretch"]) == (2.4, 0.1),
    more=lambda p: {"counts": ring(8, 4) if p["pressure"] < 10 else ring(*(16, 8) if p["pressure"] < 40 else (24, 12))},
)  # fmt: skip
# the reference is staggered; `tube, long` has the relaxed ones
table("tube", tube_case, {"driver": DRIVERS, "frame": FRAMES, "coupling": ("staggered",)})

# hundred passes, where what over-corrects has left the symmetric solution
table(
    "tube, long", tube_case, {"driver": DRIVERS, "frame": FRAMES, "coupling": ("staggered", "relaxed")},
    {"time.end": 120.0, "time.step": 1.0, "mesh.degree": 1}, more=LONG,
)  # fmt: skip

table(
    "tube, parameters", tube_case, {"r0/L": (0.05, 0.3, 0.6, 0.9, 0.99), "pressure": (0.5, 2.4)},
    lambda p: {"cells.end_to_end_length": p["r0/L"] * 1.594, "loads.elongation.value": 0.0},
)  # fmt: skip
table(
    "tube, parameters", tube_case, {"lambda/mu": (0.1, 10.0, 100.0, 1e3, 1e4), "element": ("hex1", "hex2")},
    lambda p: {**element(p), "loads.pressure.value": 2.4},
    more=lambda p: LONG if p["element"] == "hex1" else long(8, 4),
)  # fmt: skip
table(
    "tube, parameters", tube_case,
    {"kappa dt": (1e-3, 0.25, 10.0), "law": ("explicit", "rate", "relaxation")},
    lambda p: {"remodeling.kappa": p["kappa dt"] / TUBE["time"]["step"], "loads.pressure.value": 2.4},
)  # fmt: skip

# inner pressure below zero: a ring that buckles; that -4.8 is unstable was measured on 0.1.0 (eigenvalue -8.7)
table(
    "suction", tube_case, {"pressure": (-0.1, -1.0, -4.8), "degree": (1, 2)}, {"loads.elongation.value": 0.0},
    more=lambda p: long(16 // p["degree"], 8 // p["degree"], unstable=True if p["pressure"] == -4.8 else None),
)  # fmt: skip

ELASTIC = {"material.chain_density": 0.0, "remodeling.law": "none", "loads.elongation.value": 0.0}
PRESSED = {
    **ELASTIC,
    "loads.pressure": ramped(4.0, pressure=2.0)["pressure"],
    "time.end": 4.0,
    "time.step": 1.0,
}
RATIOS = (0.1, 1.0, 10.0, 100.0, 1e3, 1e4, 1e5)
# the tolerance is the error that the mesh has where nothing locks, at most the 5 % from which a run warns, or 3.5 %
MESHES = {
    "hex1 16x8": ("hexahedron", 1, ring(16, 8), 0.05), "hex1 32x16": ("hexahedron", 1, ring(32, 16), 0.035),
    "hex2 8x4": ("hexahedron", 2, ring(8, 4), 0.035), "tet1 16x8": ("tetrahedron", 1, ring(16, 8), 0.05),
    "tet2 16x8": ("tetrahedron", 2, ring(16, 8), 0.035),  # 8 x 4 of them: 1.1 to 5.6 % off, eight times as much
}  # fmt: skip


def thick_wall(family: str, changes: Values, place: Place, **more: Any) -> Case:
    """Without chains, p = 2, on one of the meshes."""
    kind, degree, counts, tolerance = MESHES[place["mesh"]]
    changes = {
        **PRESSED,
        "mesh.formulation": "displacement",
        "mesh.element": kind,
        "mesh.degree": degree,
        **changes,
    }
    more |= {"counts": counts, "options": {"tolerance": tolerance}}
    return tube_case(family, changes, place, check_inner_displacement, **more)


# towards incompressibility
table(
    "locking", thick_wall, {"mesh": MESHES, "lambda/mu": RATIOS},
    reduced=lambda p: p["mesh"] == "hex2 8x4" and p["lambda/mu"] in (1.0, 100.0),
)  # fmt: skip


# ---------------------------------------------------------------- tendons
def check_half_step(case: Case, run: Run) -> Finding:
    """The same with half of the step: a column, the mean angle and A of the elements at the end."""
    other = run.companion
    if other is None or other.code != 0 or run.code != 0:
        return Finding(
            np.nan if run.code == 0 else 0.0, "half of the step does not come to the end"
        )
    name = case.options.get("column", "mean_stretch")
    share = abs(run.column(name)[-1] / other.column(name)[-1] - 1)
    angle = abs(run.column("mean_fibre_angle")[-1] - other.column("mean_fibre_angle")[-1])
    swing = run.structure_tensor() - other.structure_tensor()
    r0 = case.scene["cells"]["end_to_end_length"]
    cells = np.sqrt(np.mean(np.sum(swing**2, axis=(1, 2)))) / r0**2
    ratio = max(share / STEP_TOLERANCE, angle / ANGLE_TOLERANCE, cells / CELL_TOLERANCE)
    words = f"half of the step: {name} {100 * share:.3g} %, angle {angle:.3g} degrees, A {cells:.2g} r0^2"
    return Finding(float(ratio), words)


def check_column(case: Case, run: Run) -> Finding:
    """The straight column's linear strain, and whether it can stay straight."""
    found = run.column("mean_stretch")
    if not len(found):
        return Finding(0.0, "no row", case.options["unstable"])
    error = abs((found[-1] - 1) / case.options["strain"] - 1)
    return Finding(error / 0.02, f"strain off by {100 * error:.3g} %", case.options["unstable"])


# ---------------------------------------------------------------- families of tendons
def tendon_case(
    family: str,
    changes: Values,
    place: Place,
    check: Check = check_half_step,
    reference: str = SAME_MESH,
    **more: Any,
) -> Case:
    """A coarse tendon."""
    scene = with_values(TENDON, changes)
    if check is check_half_step:
        more["companion"] = with_values(scene, {"time.step": scene["time"]["step"] / 2})
    return Case(family, named(family, place), scene, check, reference, place, COARSE_TENDON, **more)


def twisted_case(family: str, changes: Values, place: Place, **more: Any) -> Case:
    """A bar that is twisted and stretched: no axes are coaxial but those on its axis."""
    loads = {
        "twist": {"value": place["twist"], "ramp": RAMP},
        "elongation": {"value": 0.1, "ramp": RAMP},
    }
    changes = {**changes, "geometry.shape": "twisted", "loads": loads, "cells.initial": "isotropic"}
    return tendon_case(
        family, changes, place, options={"column": "stored_energy"}, extended=True, **more
    )


# every driver, frame and coupling, from weak loads to locking
table(
    "random cells", tendon_case,
    {"driver": DRIVERS, "frame": FRAMES, "coupling": ("staggered", "relaxed"), "force": (30.0, 300.0)},
)  # fmt: skip
table("random cells", tendon_case, {"frame": FRAMES, "force": (0.01, 1.0, 1000.0, 3000.0)})

# a slender column without chains, clamped at its bottom
COLUMN_AREA = 0.1
YOUNG = MU * (3 * 27.293 + 2 * MU) / (27.293 + MU)
EULER = np.pi**2 * YOUNG * COLUMN_AREA**2 / (4 * np.pi) / (4 * 10.0**2)
table(
    "buckling", tendon_case, {"force over Euler's": (0.25, 0.5, 2.0, 10.0, 100.0)},
    lambda p: {
        "geometry.area": COLUMN_AREA, "material.chain_density": 0.0, "remodeling.law": "none", "mesh.degree": 2,
        "loads.force": {"value": -p["force over Euler's"] * EULER, "ramp": [[0.0, 0.0], [4.0, 1.0]]}, "time.end": 4.0,
    },
    more=lambda p: {
        "check": check_column, "reference": "Euler's load", "options": {
            "unstable": p["force over Euler's"] > 1, "strain": -p["force over Euler's"] * EULER / COLUMN_AREA / YOUNG,
        },
    },
)  # fmt: skip

table(
    "torsion", twisted_case,
    {"driver": DRIVERS, "frame": FRAMES, "coupling": ("staggered", "relaxed"), "twist": (0.5, 3.0)}, only=has_frame,
)  # fmt: skip
