"""The paper's tendon, of isotropic cells and of random ones: steps and laws on the same mesh and cells."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.precision.whole import EVERY_TANGENT
from remodel_fenicsx.scene.scene import Scene, preset_scene

Array = NDArray[np.float64]
Measured = Callable[[Scene, list[float]], dict[str, Array]]

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


def run(folder: Path, measured: Measured) -> None:
    """What is not kept yet."""
    for name, (_, preset, values) in LAWS.items():
        for words, changes in runs(name).items():
            kept = _kept(folder, name, words)
            if not kept.exists():
                found = measured(
                    preset_scene(preset, "tendon").with_values({**EVERY_TANGENT, **values, **changes}), TIMES
                )
                np.savez(kept, **found)
                print(f"tendon {name:12} {words}: {float(found['seconds']):.2g} s", flush=True)


def _kept(folder: Path, name: str, words: str) -> Path:
    return folder / f"tendon-{name}-{words.replace(' ', '-')}.npz"


def rows(folder: Path) -> str:
    """The table of the page; the finest steps of each law are what the others are compared with."""
    lines = []
    for name, (law, *_) in LAWS.items():
        finest = _kept(folder, name, f"{STEPS.get(name, FINE)[-1]:g}")
        measured = [words for words in runs(name) if _kept(folder, name, words).exists()]
        if not finest.exists():
            print(f"tendon {name}: {finest} is missing; left out of the page")
            continue
        with np.load(finest) as kept:
            angles, lengths = kept["angles"], kept["lengths"]
        for number, words in enumerate(measured):
            with np.load(_kept(folder, name, words)) as kept:
                known = np.isfinite(angles).all(axis=0)  # a point has no angles along it
                away = float(np.sqrt(np.mean((kept["angles"] - angles)[:, known] ** 2))) if known.any() else np.nan
                apart = f"{away if away > NOTHING else 0:.2g}" if known.any() else ""
                off = 100 * float(np.max(np.abs(kept["lengths"] / lengths - 1)))
                percent = off if off > NOTHING else 0.0
                errors = f"{apart} | {percent:.2g}" if _kept(folder, name, words) != finest else "| the finest"
                stretch = " | ".join(f"{kept['lengths'][TIMES.index(time), 0]:.4f}" for time in (12.0, 150.0))
                work = f"{int(kept['rows'])} | {int(kept['iterations'])} | {float(kept['seconds']):.2g}"
            lines.append(f"| {'' if number else law} | {words} | {work} | {errors} | {stretch} |")
    return "\n".join(lines)
