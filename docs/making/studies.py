"""What docs/verification.md shows beside the figures: comparisons with the radial reference.

Each study is a table, NAME.csv. They take minutes.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from demos.figures import scenes
from docs.making.pages import by_column, side_by_side
from remodel_fenicsx.studies.study import Page
from tests.runs import last_row

Row = dict[str, Any]
# ---------------------------------------------------------------- against the radial reference


def comparison(setting: Any) -> Row:
    """A setting of docs/making/radial_comparison.py and its errors; radii in percent, angles in degrees."""
    from docs.making import radial_comparison

    found = radial_comparison.errors(setting)
    return {
        "stretch": setting.stretch, "pressure": setting.pressure, "driver": setting.driver, "law": setting.law,
        "supports": "symmetry planes" if setting.planes else "the scene's", "degree": setting.degree,
        "around": setting.divisions[0], "through": setting.divisions[1], "end": setting.end,
        "front_from": setting.front[0], "front_to": setting.front[1],
        "radii_percent": 100 * max(found["inner_radius_error"], found["outer_radius_error"]), **found,
    }  # fmt: skip


def layer_mean(setting: Any) -> Row:
    """The mean angle in the fourth of eight layers of the wall, the last before its middle."""
    from docs.making import radial_comparison

    run, exact = radial_comparison.finite_elements(setting), radial_comparison.reference(setting)
    layer = (run.R > 1.75) & (run.R < 2.0)
    mean = float(np.average(run.angle[layer], weights=run.volume[layer]))
    return {"around": setting.divisions[0], "through": setting.divisions[1], "degree": setting.degree,
            "fibre_angle_4": mean, "reference_4": exact.mean_fibre_angle(1.75, 2.0)}  # fmt: skip


# ---------------------------------------------------------------- a single run


def stiff_tendon(name: str, **changes: Any) -> Row:
    """The tendon with four times the energy of its chains (erratum 1): its stretch at the end."""
    row = last_row(
        scenes()[name].with_values({"output.fields": False, "material.energy_factor": 4, **changes})
    )
    return {name: row[name] for name in ("time", "mean_stretch")}


# ---------------------------------------------------------------- all of them
def jobs() -> dict[str, tuple[Callable[[Any], Row], list[Any]]]:
    """By table, what gives a row of it, and of which cases."""
    from docs.making import radial_comparison as compared

    meshes = [setting for settings in compared.CONVERGENCE.values() for setting in settings]
    # Fig. 9's pure pressure on the paper's mesh, in one layer along z, and on one twice as fine
    pressed = [compared.Setting(0.0, 4.8, divisions=(12 * n, 8 * n, 1), degree=1) for n in (1, 2)]
    return {
        "stiff-tendon": (stiff_tendon, ["tendon"]),
        "comparison-cases": (comparison, compared.LOAD_CASES),
        "comparison-drivers": (comparison, compared.DRIVERS),
        "pressure-meshes": (layer_mean, pressed),
        "comparison-meshes": (comparison, meshes),
    }


def study(folder: Path, keep: bool) -> list[str]:
    """Write the tables, or with `keep` only those that are not there; returns the names of all."""
    tables = jobs()
    for name, (function, cases) in tables.items():
        if not (keep and (folder / f"{name}.csv").is_file()):
            print(f"verification: {name}", file=sys.stderr, flush=True)
            Page(folder, name).save_table(
                by_column(side_by_side(function, cases)), ["docs/making/studies.py"]
            )
    return list(tables)
