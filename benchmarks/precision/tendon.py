"""The paper's tendon, of isotropic cells and of random ones: steps and laws on the same mesh and cells."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from benchmarks.precision.kept import EVERY_TANGENT, Kept
from docs.making.pages import lines
from remodel_fenicsx.scene.scene import preset_scene

TIMES = [12.0, 24.0, 48.0, 72.0, 96.0, 120.0, 132.0, 150.0]
PRINTED = "kuhl-holzapfel-2007"
ISOTROPIC = {"cells.initial": "isotropic", "model.kinematics": "point"}
LAWS: dict[str, tuple[str, str, Mapping[str, Any]]] = {
    "isotropic-printed": ("isotropic cells, eq. (11), staggered", PRINTED, ISOTROPIC),
    "isotropic-consistent": ("isotropic cells, `tensor`, `extrapolated`", "consistent", ISOTROPIC),
    "printed": ("random cells, eq. (11), staggered", PRINTED, {}),
    "consistent": ("random cells, `tensor`, `extrapolated`", "consistent", {}),
}
# the last is what the others are held against
FINE = (3.0, 2.0, 1.0, 0.5, 0.25)
STEPS = {"printed": (3.0, 2.0, 1.0, 0.5), "consistent": (3.0, 2.0, 1.0)}
NOTHING = 1e-6  # per cent or degrees: the solver's tolerance
TOLERANCES = (1.0,)


def runs(name: str) -> dict[str, Mapping[str, Any]]:
    """The settings of a law, by what the page calls them."""
    steps = {f"{step:g}": {"time.step": step} for step in STEPS.get(name, FINE)}
    return steps | {f"tolerance {value:g}": {"time.tolerance": value} for value in TOLERANCES}


def run(kept: Kept) -> None:
    """What is not kept yet."""
    for name, (_, preset, values) in LAWS.items():
        for words, changes in runs(name).items():
            scene = preset_scene(preset, "tendon").with_values({**EVERY_TANGENT, **values, **changes})
            kept.measure(f"tendon-{name}-{words}", scene, TIMES)


def rows(kept: Kept) -> str:
    """The table of the page; the finest steps of each law are what the others are compared with."""
    return lines(_rows(kept))


def _rows(kept: Kept) -> Iterator[list[str]]:
    for name, (law, *_) in LAWS.items():
        finest = f"{STEPS.get(name, FINE)[-1]:g}"
        exact = kept[f"tendon-{name}-{finest}"]
        for number, words in enumerate(runs(name)):
            one, lengths = (found := f"tendon-{name}-{words}"), kept[found]["lengths"]
            off = kept.found(one, exact["angles"], exact["lengths"])
            degrees = "" if np.isnan(off.typical) else f"{off.typical if off.typical > NOTHING else 0:.2g}"
            errors = [degrees, f"{off.percent if off.percent > NOTHING else 0:.2g}"]
            stretch = [f"{lengths[TIMES.index(time), 0]:.4f}" for time in (12.0, 150.0)]
            work = [f"{off.rows}", f"{off.iterations}", f"{off.seconds:.2g}"]
            yield ["" if number else law, words, *work, *(errors if words != finest else ["", "the finest"]), *stretch]
