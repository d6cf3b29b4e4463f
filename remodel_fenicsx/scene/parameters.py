"""Parameters of matrix, chains, cells and remodeling with their units, and the named presets of the paper.

Source: E. Kuhl, G. A. Holzapfel, J. Mater. Sci. 42 (2007) 8811-8823; docs/theory.md has the equations as implemented.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from remodel_fenicsx.model.cells import AXES
from remodel_fenicsx.model.chains import BOLTZMANN_CONSTANT, CHAINS
from remodel_fenicsx.model.drivers import DRIVERS, FRAMES
from remodel_fenicsx.model.energy import MATRICES, Tissue
from remodel_fenicsx.model.laws import LAWS
from remodel_fenicsx.model.repulsion import REPULSIONS
from remodel_fenicsx.model.spectral import PAIRINGS
from remodel_fenicsx.schema.tables import Table, checked, fault, is_number, one_of, shown
from remodel_fenicsx.schema.units import NUMBER_DENSITY, STRESS, TEMPERATURE

COUPLING_MEANINGS = {
    "staggered": "solve with the cells of the step before, then remodel once",
    "relaxed": "the same with a share, relaxation_factor, of what the pass changes: half of it is stable for every "
    "driver and frame but under weak loads, where 'staggered' over-corrects with 'pk2' and 'finger'",
    "extrapolated": "remodel first, towards the stress of the middle of the step, extrapolated from the two steps "
    "before; then solve: of second order, for the law 'tensor'",
    "implicit": "the cells belong to the stress of the same step: Newton's method on both, for the law 'tensor' (with "
    "a repulsion that sees no axes) and the laws of the paper",
}
"""What each of `evolution.coupling.COUPLINGS` does; that room is above this one, and a test holds the two together."""
OF_SHARES = ("relaxed",)
FOR_LAWS_WITH_A_TARGET = ("extrapolated",)
STRESS_UNITS = {"Pa": 1.0, "kPa": 1.0e3, "MPa": 1.0e6}  # in Pa
INITIAL_CELLS = ("random", "isotropic", "aligned")
FORMAT = 2  # of recorded scenes: raised where a reader of the one before would not understand them
RENAMED = {"mesh.cell": "mesh.element", "loads.stretch": "loads.elongation", "solver.profile": "solver.method"}
"""Dotted key of an earlier format -> the key that has taken its place, for the error."""


class Material(Table):
    """The tissue: an isotropic matrix (Lame constants) with a network of collagen chains."""

    lame_lambda: Annotated[float, STRESS] = Field(
        default=27.293, ge=0, description="First Lame constant lambda of the matrix, in stress_unit."
    )
    lame_mu: Annotated[float, STRESS] = Field(
        default=3.103, gt=0, description="Second Lame constant mu of the matrix, in stress_unit."
    )
    chain_density: Annotated[float, NUMBER_DENSITY] = Field(
        default=2.0e21, ge=0, description="Number of chains n_chn per volume, in 1/m^3; 0: no chains."
    )
    contour_length: float = Field(
        default=1.594, gt=0, description="Contour length L of a chain, at which it locks, in link lengths."
    )
    persistence_length: float = Field(
        default=1.365,
        gt=0,
        description="Persistence length A_p of a chain, its bending stiffness over k theta, in link lengths.",
    )
    temperature: Annotated[float, TEMPERATURE] = Field(
        default=310.0, gt=0, description="Absolute temperature theta, in K."
    )
    energy_factor: Annotated[int, one_of((1, 4))] = Field(
        default=1,
        description="Factor omega of the chain energy: 1 is the stress as printed (eq. 7; reproduces Fig. 6), "
        "4 the energy as printed (eq. 4b).",
    )
    matrix: Annotated[str, one_of(MATRICES)] = Field(default="neo-hookean", description="Energy of the matrix.")
    chain: Annotated[str, one_of(CHAINS)] = Field(default="wormlike", description="Force law of a single chain.")
    repulsion: Annotated[str, one_of(REPULSIONS)] = Field(
        default="axes",
        description="Form of the repulsive energy that makes the reference state stress-free: 'axes' is the paper's, "
        "in the stretches along the three cell axes; 'log' sees the structure tensor alone (A : ln C), equals it where "
        "both have the same axes and suits the law 'tensor'; 'length' is a function of the chains' length alone. Where "
        "neither scene nor preset says it: 'log' with the law 'tensor'.",
    )
    stress_unit: Literal["Pa", "kPa", "MPa"] = Field(
        default="Pa",
        description="Unit of every stress, pressure and Lame constant of the scene; forces are in it times the unit of "
        "length squared.",
    )

    @property
    def network_modulus(self) -> float:
        """c = omega k theta n_chn / (4 A_p), in stress_unit (1.568 Pa for the defaults)."""
        pascal = BOLTZMANN_CONSTANT * self.temperature * self.chain_density / (4 * self.persistence_length)
        return self.energy_factor * pascal / STRESS_UNITS[self.stress_unit]

    def tissue(self, end_to_end_length: float) -> Tissue:
        """The tissue of these parameters; without chains where there are none.

        Parameters
        ----------
        end_to_end_length
            r0, in link lengths.
        """
        return Tissue(
            self.lame_lambda,
            self.lame_mu,
            self.network_modulus,
            self.contour_length,
            end_to_end_length,
            CHAINS[self.chain] if self.chain_density > 0 else None,
            MATRICES[self.matrix],
            REPULSIONS[self.repulsion],
        )

    def summary(self, loads: Mapping[str, float]) -> str:
        """Stiffness of network and matrix and the loads, in one unit and on one line.

        Parameters
        ----------
        loads
            Stresses by the words for them, in stress_unit.
        """
        stresses = {"network modulus c =": self.network_modulus, "shear modulus mu =": self.lame_mu, **loads}
        return ", ".join(f"{words} {value:.4g} {self.stress_unit}" for words, value in stresses.items())


def _initial_cells(value: Any) -> Any:
    """A list of three lengths becomes a tuple of floats; names pass."""
    if isinstance(value, (list, tuple)):
        if len(value) != 3 or not all(is_number(length) and length >= 0 for length in value):
            raise fault("must be three lengths [l1, l2, l3], each at least 0")
        return tuple(float(length) for length in value)
    if not isinstance(value, str) or value not in INITIAL_CELLS:
        raise fault("allowed are " + ", ".join(map(repr, INITIAL_CELLS)) + " or three lengths [l1, l2, l3]")
    return value


class Cells(Table):
    """The orthotropic unit cells of the collagen network before the first remodeling pass."""

    initial: Annotated[str | tuple[float, float, float], checked(_initial_cells)] = Field(
        default="random",
        description="Cell dimensions l_I at t = 0, with |l| = end_to_end_length: 'random' (one draw per element, "
        "uniform on the positive octant of the sphere), 'isotropic' (three equal ones), 'aligned' (all of it along "
        "aligned_axis), or [l1, l2, l3] in link lengths.",
        json_schema_extra={"allowed": "'random', 'isotropic', 'aligned' or three lengths [l1, l2, l3]"},
    )
    axes: Annotated[str, one_of(AXES)] = Field(
        default="global",
        description="Cell axes n_I before the first pass: 'global' (x, y, z) or 'cylindrical' (circumferential, axial, "
        "radial, about the z axis). Where neither scene nor preset says it: a tube starts with 'cylindrical'.",
    )
    aligned_axis: Annotated[int, one_of((1, 2, 3))] = Field(
        default=3,
        description="Number of the axis that 'aligned' cells lie along: with global axes 3 is z, the load axis of cube "
        "and tendon; with cylindrical axes 1 is circumferential, 2 axial, 3 radial.",
    )
    seed: int = Field(
        default=1,
        ge=0,
        description="Seed of the random cells. The same seed and mesh give the same cells on any number of processes.",
    )
    end_to_end_length: float = Field(
        default=1.0,
        gt=0,
        description="Length r0 of a chain at t = 0, in link lengths; smaller than material.contour_length. A material "
        "constant: it keeps its value in the repulsive energy while the cells remodel.",
    )

    @model_validator(mode="after")
    def _length_of_the_chain(self) -> Cells:
        if not isinstance(self.initial, str):
            length = math.hypot(*self.initial)
            if abs(length - self.end_to_end_length) > 1e-6 * self.end_to_end_length:
                raise fault(
                    f"the root of the sum of squares is {length:.7g}, it must be "
                    f"cells.end_to_end_length = {shown(self.end_to_end_length)}",
                    "initial",
                    self.initial,
                )
        return self


class Remodeling(Table):
    """How the cells follow the load: driving tensor, evolution law, frame and speed."""

    driver: Annotated[str, one_of(DRIVERS)] = Field(
        default="cauchy",
        description="Tensor whose positive eigenvalues the cells follow: 'cauchy' stress, second Piola-Kirchhoff "
        "stress 'pk2', or 'finger' tensor b (it remodels even a body without load, and l_3 does not vanish).",
    )
    law: Annotated[str, one_of(LAWS)] = Field(
        default="explicit",
        description="Evolution of the cells: 'explicit' is eq. (11), in absolute time; 'rate' integrates eq. (10); "
        "'relaxation' is dl/dt = kappa (r0 e - l), right for changing loads; 'rotation' (Remark 5) turns the axis of "
        "the largest dimension gradually and leaves the dimensions alone; 'tensor' is 'relaxation' for the "
        "structure tensor as a whole, without ranks and axes; 'none' leaves the cells alone. Where neither scene nor "
        "preset says it: 'tensor'.",
    )
    frame: Annotated[str, one_of(FRAMES)] = Field(
        default="material",
        description="Axes of the remodeled cells, for the drivers 'cauchy' and 'finger': 'material' takes the fibres "
        "that the deformation carries onto the principal directions (objective), 'spatial' the principal directions "
        "themselves, as printed. The driver 'pk2' has material eigenvectors of its own.",
    )
    pairing: Annotated[str, one_of(PAIRINGS)] = Field(
        default="sorted",
        description="Which dimension follows which principal value: 'sorted' by rank, as printed (where two values "
        "cross, the cell turns by 90 degrees at once), 'continuous' by axis (each principal direction goes on from the "
        "axis that it overlaps most). The law 'rotation' does not ask.",
    )
    coupling: Annotated[str, one_of(COUPLING_MEANINGS)] = Field(
        default="staggered",
        description="; ".join(f"{name!r}: {text}" for name, text in COUPLING_MEANINGS.items())
        + ". Where neither scene nor preset says it: 'extrapolated' with the law 'tensor'.",
    )
    relaxation_factor: float = Field(
        default=0.5,
        gt=0,
        le=1,
        description="Share theta of a pass's change of the structure tensor that 'relaxed' makes; 1 is 'staggered'.",
    )
    kappa: float = Field(
        default=0.025, ge=0, description="Speed of remodeling kappa, in 1/time; a difference fades like exp(-kappa t)."
    )
    rotation_time: float = Field(
        default=40.0,
        gt=0,
        description="Time of the law 'rotation': a small angle between fibre and tension fades like "
        "exp(-t / rotation_time).",
    )

    def warnings(self) -> list[str]:
        """A line on a law that a share of each pass makes slower."""
        law, share = LAWS[self.law], self.relaxation_factor
        if self.coupling not in OF_SHARES or share == 1 or not law.remodels or law.of_absolute_time:
            return []
        return [
            f"remodeling.coupling = {self.coupling!r} makes a share of {share:g} of each pass, and the law "
            f"{self.law!r} does not make up for the rest: cells remodel at about {share:g} times the speed"
        ]

    @model_validator(mode="after")
    def _coupling_fits_the_law(self) -> Remodeling:
        if self.coupling in FOR_LAWS_WITH_A_TARGET and LAWS[self.law].target is None:
            laws = ", ".join(repr(name) for name, law in LAWS.items() if law.target is not None)
            raise fault(
                f"needs a remodeling.law with a target that can be extrapolated: {laws}", "coupling", self.coupling
            )
        return self


# ---------------------------------------------------------------- without a preset

DEFAULT_LAW = "tensor"
_METHODS: dict[str, dict[str, dict[str, Any]]] = {
    DEFAULT_LAW: {"material": {"repulsion": "log"}, "remodeling": {"law": DEFAULT_LAW, "coupling": "extrapolated"}},
}


def default_method(values: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """What lies under the keys of a scene without a preset: the law, and what goes with the law that it has.

    It is what measures best (docs/couplings.md); a scene that names another law has the defaults of the tables.
    """
    remodeling = values.get("remodeling")
    law = remodeling.get("law", DEFAULT_LAW) if isinstance(remodeling, Mapping) else DEFAULT_LAW
    return _METHODS.get(law, {}) if isinstance(law, str) else {}


# ---------------------------------------------------------------- presets


def _printed_method(
    geometry: dict[str, Any], loads: dict[str, Any], end: float, material: dict[str, Any], cells: dict[str, Any]
) -> dict[str, dict[str, Any]]:
    """The paper's method on one of its bodies, every choice spelled out; how systems are solved is none of them."""
    common_material = {
        "lame_lambda": 27.293,
        "lame_mu": 3.103,
        "temperature": 310.0,
        "energy_factor": 1,
        "matrix": "neo-hookean",
        "chain": "wormlike",
        "repulsion": "axes",
        "stress_unit": "Pa",
    }
    return {
        "geometry": geometry,
        "mesh": {"refinement": 1, "element": "hexahedron", "degree": 1, "formulation": "displacement"},
        "model": {"kinematics": "full"},
        "material": common_material | material,
        "cells": {"end_to_end_length": 1.0} | cells,
        "loads": loads,
        "remodeling": {
            "driver": "cauchy",
            "law": "explicit",
            "frame": "spatial",
            "pairing": "sorted",
            "coupling": "staggered",
            "kappa": 0.025,
        },
        "time": {"end": end, "step": 1.0},
    }


def _load(value: float, end_of_ramp: float) -> dict[str, Any]:
    return {"value": value, "ramp": [[0.0, 0.0], [end_of_ramp, 1.0]]}


_STIFFER_CHAINS = {"chain_density": 7.0e21, "contour_length": 2.125, "persistence_length": 1.82}
_CHAINS = {"chain_density": 2.0e21, "contour_length": 1.594, "persistence_length": 1.365}

_PAPER = {
    "cube": _printed_method(
        {"side": 1.0},
        {"force": _load(10.0, 10.0)},
        100.0,
        _STIFFER_CHAINS,
        {"initial": "isotropic", "axes": "global"},
    ),
    "tendon": _printed_method(
        {"length": 10.0, "area": 10.0},
        {"force": _load(300.0, 12.0)},
        150.0,
        _CHAINS,
        {"initial": "random", "axes": "global", "seed": 1},
    ),
    "tube": _printed_method(
        {"inner_radius": 1.0, "outer_radius": 3.0, "length": 8.0},
        {"pressure": _load(4.8, 25.0), "elongation": _load(0.1, 25.0)},
        150.0,
        _CHAINS,
        {"initial": "random", "axes": "cylindrical", "seed": 1},
    ),
}

# Lengths in nm. r0 is the root mean square end-to-end length of the free chain,
# sqrt(2 A_p L (1 - A_p/L (1 - e^(-L/A_p)))), and the density makes c g(r0) r0^2, the initial stiffness of
# the network, that of the paper's tendon and artery.
_MEASURED_COLLAGEN = {"chain_density": 9.0e20, "contour_length": 309.0, "persistence_length": 14.5}
_FREE_CHAIN = 92.4


def _with_measured_collagen(scene: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return scene | {
        "material": scene["material"] | _MEASURED_COLLAGEN,
        "cells": scene["cells"] | {"end_to_end_length": _FREE_CHAIN},
    }


def _consistent(scene: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    changes = {"law": "tensor", "frame": "material", "coupling": "extrapolated"}
    return scene | {
        "material": scene["material"] | {"repulsion": "log"},
        "remodeling": {name: value for name, value in (scene["remodeling"] | changes).items() if name != "pairing"},
    }


PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "kuhl-holzapfel-2007": _PAPER,
    "consistent": {shape: _consistent(scene) for shape, scene in _PAPER.items()},
    "sun-2002": {shape: _with_measured_collagen(scene) for shape, scene in _PAPER.items()},
}
"""Preset name -> shape -> scene keys; they lie under the keys of the scene that names the preset."""

PRESET_NOTES = {
    "kuhl-holzapfel-2007": "The printed method on the three bodies of the paper: Fig. 5 (cube), Fig. 6 (tendon), "
    "Figs. 7 to 11 (tube). The frame is 'spatial', as printed in eq. (9).",
    "consistent": "The paper's bodies and parameters with a law and an energy that see the structure tensor alone "
    "(docs/theory.md, The consistent variant), second order in the time step.",
    "sun-2002": "The printed method with collagen I as measured with optical tweezers (paper, Remark 2): contour "
    "length 309 nm, persistence length 14.5 nm, all chain lengths in nm. End-to-end length (that of a free chain) and "
    "chain density (the same initial stiffness of the network) are choices of this project, not of the paper.",
}
