"""Settings of a scene from coarse to fine: what `remodel-fenicsx trade` runs, each a scene that a user could take."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from remodel_fenicsx.body.columns import PROFILE
from remodel_fenicsx.body.reductions import AUTO, choice, is_for_means, objections, step_cost
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.model.laws import LAWS
from remodel_fenicsx.scene.presets import EXACT, PROFILES, profile_for
from remodel_fenicsx.scene.scene import Scene, SceneError

log = logging.getLogger(__name__)

SECONDS_PER_POINT = 3e-5  # of a step: a first guess, corrected by the runs
COST_OF_EXACT = 20.0  # of a step with the coupling that has no error in time, in others, as measured on the artery
DEGREES_PER_RUN = 60.0  # what angles turn by: steps of a tolerance are about so many tolerances
STEPS = (8.0, 5.0, 4.0, 2.5, 2.0)  # longer ones than the scene's, in its own
FINER_STEPS = 3  # of the scene's own step
TOLERANCES = (2.0, 1.0, 0.5, 0.25)  # degrees
MESHES = ((1, 1), (2, 1), (4, 1), (8, 1), (1, 2), (2, 2), (4, 2))  # refinement, degree
TOGETHER = ((2, 1, 0.5), (2, 2, 0.5), (2, 2, 0.25), (4, 2, 0.25))  # both finer: refinement, degree, step in the scene's
SEEDS = 3  # where another mesh draws other cells
COMPARED = 8  # times at which rows are compared, beside corners of ramps and the end
STRETCH, COUPLING = "mean_stretch", "remodeling.coupling"
TIME, MESH, BOTH, KINEMATIC = "time", "mesh", "both", "kinematics"


@dataclass(frozen=True)
class Setting:
    """One row of the table.

    Attributes
    ----------
    name
        Of its files.
    factor
        What it varies: TIME, MESH, BOTH or KINEMATIC.
    changes
        Values over the scene by dotted key.
    scene
        The user's scene with them.
    seeds
        Of its runs; one where cells are not random or are the same.
    profile
        Name of the profile that it is.
    """

    name: str
    factor: str
    changes: Mapping[str, Any] = field(hash=False)
    scene: Scene = field(hash=False)
    seeds: tuple[int, ...]
    profile: str = ""

    @property
    def step(self) -> float | None:
        """The fixed step; None with a tolerance."""
        return self.scene.time.step if self.scene.time.tolerance is None else None

    @property
    def mesh(self) -> tuple[str, int, int]:
        """Kinematics, refinement and degree."""
        return self.scene.model.kinematics, self.scene.mesh.refinement, self.scene.mesh.degree

    @property
    def way(self) -> tuple[str, str]:
        """Kinematics and coupling: what a step costs goes by them."""
        return self.scene.model.kinematics, self.scene.remodeling.coupling

    @property
    def expected_seconds(self) -> float:
        """Of one of its runs, roughly."""
        time, is_exact = self.scene.time, self.scene.remodeling.coupling == EXACT
        steps: float = time.number_of_steps
        if time.tolerance is not None:  # where steps have no error they are as long as they may be
            steps = COMPARED if is_exact else DEGREES_PER_RUN / time.tolerance
        cost = step_cost(self.scene, self.scene.model.kinematics) * (COST_OF_EXACT if is_exact else 1.0)
        return SECONDS_PER_POINT * cost * steps

    @property
    def steps_in_words(self) -> str:
        """How long they are, or their tolerance."""
        return f"step {self.step:g}" if self.step is not None else f"tolerance {self.scene.time.tolerance:g}"

    def in_words(self) -> str:
        """Kinematics, mesh, steps and coupling on a line."""
        kinematics, refinement, degree = self.mesh
        mesh = "" if KINEMATICS[kinematics].homogeneous else f" refinement {refinement} degree {degree}"
        profile = f" (profile {self.profile})" if self.profile else ""
        coupling = f" {self.way[1]}" if COUPLING in self.changes else ""
        return f"{kinematics:12}{mesh} {self.steps_in_words}{coupling}{profile}"


def ladder(scene: Scene) -> list[Setting]:
    """All settings that the scene allows, each once: sweeps of one factor from the cheapest kinematics, then both.

    Raises
    ------
    SceneError
        If steps of the scene's own length do not hit its corners and its end: with a tolerance they need not.
    """
    solved = choice(scene).name
    # without its profile, which would choose the steps of every row; what the profile has set stays
    base = scene.with_values({"model.kinematics": _cheapest(scene), "time.tolerance": None, "profile": None})
    step, mesh = base.time.step, (base.mesh.refinement, base.mesh.degree)
    random, seed = scene.has_random_cells, scene.cells.seed
    several = tuple(range(seed, seed + SEEDS)) if random else (seed,)
    found: dict[str, Setting] = {}

    def known(values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Without those of a mesh that means nothing, or is given."""
        homogeneous = KINEMATICS[values.get("model.kinematics", base.model.kinematics)].homogeneous
        if scene.geometry.refines and not homogeneous:
            return values
        return {key: value for key, value in values.items() if not key.startswith("mesh.")}

    def add(factor: str, seeds: tuple[int, ...], values: Mapping[str, Any], profile: str = "") -> Setting | None:
        values = known(values)
        try:
            changed = base.with_values(values)
        except SceneError as error:  # a step of which a corner is no multiple, an element that a formulation has not
            log.debug("left out: %s", error)
            return None
        name = _name(changed) + (f"-{values[COUPLING]}" if COUPLING in values else "")
        setting = Setting(f"profile-{profile}" if profile else name, factor, values, changed, seeds, profile)
        return found.setdefault(name, setting)

    def meshes(refinement: int, degree: int) -> dict[str, int]:
        return {"mesh.refinement": refinement * mesh[0], "mesh.degree": degree}

    add(MESH, several, {})
    remodels = LAWS[scene.remodeling.law].remodels
    for name in PROFILES if remodels else ():
        profile = profile_for(name, base)
        own = {"model.kinematics": base.model.kinematics}
        values = profile.settings(base.with_values(known(profile.values | own)))
        values |= own if values["model.kinematics"] == AUTO else {}
        if values != own and all(values != setting.changes for setting in found.values()):
            add(BOTH, several, values, name)
    for factor in [*STEPS, *(0.5**k for k in range(1, FINER_STEPS + 1))]:
        add(TIME, (seed,), {"time.step": factor * step})
    for refinement, degree in MESHES:
        add(MESH, several, meshes(refinement, degree))
    for refinement, degree, factor in TOGETHER:
        add(BOTH, several, meshes(refinement, degree) | {"time.step": factor * step})
    for tolerance in TOLERANCES if remodels else ():
        add(BOTH, several, meshes(2, 2) | {"time.tolerance": tolerance})
        add(TIME, (seed,), {"time.tolerance": tolerance})
    if base.has_exact_coupling and base.remodeling.coupling != EXACT:  # long steps are as good as short ones, and pay
        values = {COUPLING: EXACT}
        longer = [add(TIME, several, values | {"time.step": factor * step}) for factor in STEPS]
        longest = max((setting.scene.time.step for setting in longer if setting is not None), default=step)
        for refinement, degree in MESHES:
            add(MESH, several, values | meshes(refinement, degree) | {"time.step": longest})
        for tolerance in TOLERANCES[:1]:
            add(BOTH, several, values | meshes(2, 2) | {"time.tolerance": tolerance})
    for name in dict.fromkeys((solved, "sector", "full")):
        if name == solved or not (objections(scene, name) or is_for_means(scene, name)):
            add(KINEMATIC, several if is_for_means(scene, name) else (seed,), {"model.kinematics": name})
    return sorted(found.values(), key=lambda setting: setting.expected_seconds)


def _cheapest(scene: Scene) -> str:
    """That of `auto`, whatever the scene says."""
    return choice(scene.with_values({"model.kinematics": AUTO})).name


def _name(scene: Scene) -> str:
    time, (kinematics, mesh) = scene.time, (scene.model.kinematics, scene.mesh)
    steps = f"step-{time.step:g}" if time.tolerance is None else f"tolerance-{time.tolerance:g}"
    return f"{kinematics}-{mesh.refinement}-degree-{mesh.degree}-{steps}"


def compared_times(scene: Scene, settings: Sequence[Setting]) -> list[float]:
    """Times that every row has: corners of ramps, the end, and some between that are whole steps of all settings."""
    fixed = [setting.scene.time for setting in settings if setting.step is not None]
    longest = max(time.step for time in fixed)
    multiples = [longest * number for number in range(1, round(scene.time.end / longest))]
    hit = [time for time in multiples if all(one.is_hit(time) for one in fixed)]
    return sorted({*scene.stops(), *hit[:: -(-len(hit) // COMPARED) or 1]})


def compared_lengths(scene: Scene) -> tuple[str, list[str]]:
    """What the lengths of a body are called, and its columns of them: radii, or the stretch of what has none."""
    columns = scene.geometry.columns
    radii = [column.name for column in columns if column.unit == "length"]
    if radii:
        return "radii", radii
    stretch = [column.name for column in columns if column.name == STRETCH]
    return ("stretch", stretch) if stretch else ("volume", [c.name for c in columns if c.unit == "length^3"])


def as_run(setting: Setting, seed: int, times: list[float]) -> Scene:
    """The scene of a run of the study: only what is compared is measured."""
    columns = [*compared_lengths(setting.scene)[1], "substeps", "seconds", "processor_seconds", *PROFILE]
    values = {"output.fields": False, "output.columns": columns, "output.times": times, "output.every": 1}
    return setting.scene.with_values({**values, "cells.seed": seed, "name": f"{setting.name}-{seed}"})


def is_reduced(setting: Setting) -> bool:
    """Whether a part stands for the body."""
    return KINEMATICS[setting.scene.model.kinematics].reduced
