"""The tables of a scene: what can be set, with units, limits and meanings; one class each, which all rooms take.

Source of the defaults of tissue and cells: E. Kuhl, G. A. Holzapfel, J. Mater. Sci. 42 (2007) 8811-8823;
docs/theory.md has the equations as implemented. A `Scene` (`scene.scene`) is made of these tables.
"""

from __future__ import annotations

import copy
import itertools
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, NoReturn, Optional

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, ConfigDict, Field, GetPydanticSchema, SerializeAsAny, create_model

from remodel_fenicsx._lazy import resolved
from remodel_fenicsx.fem.formulations import FORMULATIONS, NOT_LOCKING, STIFF_BULK
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.fem.solver_methods import (
    AUTO,
    LARGE,
    REMOVED,
    SMALL_BODY,
    SMALL_REDUCTION,
    SOLVER_METHODS,
    fault_of_option,
)
from remodel_fenicsx.model.axes import AXES, GROWTH, NATURAL_GRADIENT
from remodel_fenicsx.model.chains import BOLTZMANN_CONSTANT, CHAINS
from remodel_fenicsx.model.drivers import DRIVERS, FRAMES
from remodel_fenicsx.model.energy import MATRICES, Matrix, REPULSIONS, TURNED_OVER, Tissue
from remodel_fenicsx.model.laws import LAWS, MEANS_OF_CASES, TURNOVER_RATES, TurnoverRule
from remodel_fenicsx.model.spectral import PAIRINGS
from remodel_fenicsx.schema.tables import (
    Faults,
    IN_A_LIST,
    KeysOfParts,
    OneOf,
    SceneError,
    Table,
    fault,
    named,
    quoted,
    shown,
    with_key,
)
from remodel_fenicsx.schema.units import FORCE, FOUNDATION, LENGTH, NUMBER_DENSITY, STRESS, TEMPERATURE

STRESS_UNITS = {"Pa": 1.0, "kPa": 1.0e3, "MPa": 1.0e6}  # in Pa
MEASURED_CELLS = "fibres"  # those of cells.fibres
MOST_STEPS = 1_000_000
NAME = r"[A-Za-z][A-Za-z0-9_]{0,39}"  # of a region or a further load: part of the name of a column
LARGEST_MESH = 10_000_000  # hexahedra; Gmsh, which is serial, needs about 10 GB for them


def meanings(registry: Mapping[str, Any]) -> str:
    """Of all that it has, for a description."""
    return ". ".join(f"{name!r}: {part.meaning}" for name, part in registry.items() if part.meaning)


# ---------------------------------------------------------------- body and mesh


class Mesh(Table):
    """The finite elements.

    Its keyword arguments are the keys of `[mesh]` in a scene (docs/scene.md).

    Raises
    ------
    SceneError
        If a value is not allowed: one line.

    Examples
    --------
    >>> from remodel_fenicsx import parts
    >>> mesh = parts.Mesh(refinement=3, element="hexahedron", degree=1)
    >>> parts.Cube(side=1.0).build(mesh).number_of_elements
    27
    >>> parts.Mesh(refinement=0)
    Traceback (most recent call last):
        ...
    remodel_fenicsx.schema.tables.SceneError: refinement = 0: must be a whole number at least 1
    """

    refinement: int = Field(default=1, ge=1)
    """Multiplies the paper's number of elements in every direction; 1 is the paper's mesh. More than 10 million
    hexahedra, or as many split into tetrahedra, are refused."""
    element: Literal["hexahedron", "tetrahedron"] = "hexahedron"
    """Shape of the elements."""
    degree: Annotated[int, OneOf((1, 2))] = 1
    """Polynomial degree of the displacement in an element: 1, as in the paper, or 2."""
    formulation: Annotated[str, OneOf(FORMULATIONS, (AUTO,))] = Field(
        default=AUTO,
        description=f"How elements treat the change of volume. 'auto' takes {NOT_LOCKING!r} where lambda/mu is above "
        f"{STIFF_BULK['hexahedron']:g} (tetrahedra of degree 2: {STIFF_BULK['tetrahedron']:g}), unless something else "
        f"needs 'displacement'. {meanings(FORMULATIONS)} (docs/what_may_go_wrong.md).",
    )

    def _faults(self) -> Faults:
        pair = self.element, self.degree
        if self.formulation != AUTO and not FORMULATIONS[self.formulation].has(*pair):
            able = named(FORMULATIONS, lambda formulation: formulation.has(*pair))
            rule = f"allowed for elements {self.element!r} of degree {self.degree} is {able}"
            yield rule, "formulation", self.formulation


class Model(Table):
    """Which unknowns describe the deformation."""

    kinematics: Annotated[str, OneOf(KINEMATICS, (AUTO,))] = Field(
        default=AUTO,
        description="'auto' takes the cheapest one that is exact for the scene. "
        f"{meanings(KINEMATICS)} (docs/kinematics.md).",
    )


class Support(Table):
    """How a face of a body of your own (shapes `'mesh'`, `'solid'`) is held, such as `[supports.inlet]`.

    NAME is a face of `geometry.faces`, or one that the file names. N is the mean outward normal of the face, or of each
    part of it, in the reference body; c goes around the middle of the part. Where a scene says nothing, inlet and
    outlet are guided and all other faces are free. A tube has `[supports.outer]` alone, for what surrounds it.
    """

    kind: Literal["guided", "sliding", "held", "elastic", "free"] = "guided"
    """'guided': the face stays in its plane and its circle stays centred, but may grow. 'sliding': the face stays in
    its plane. 'held': the face moves along N alone, as loads.elongation says. 'elastic': springs of fixed direction.
    'free': nothing holds the face (docs/my_own_vessel.md, Supports)."""
    stiffness: Annotated[float | None, FOUNDATION] = Field(default=None, gt=0)
    """Force per area and displacement, in stress_unit over the scene's unit of length. 'elastic' needs it. For 'guided'
    and 'sliding' the default is 1000 (lame_lambda + 2 lame_mu) over the wall's thickness."""
    tangential: float = Field(default=1.0, ge=0, le=1)
    """For 'elastic': stiffness across N over stiffness along N. Below 0.5 a wall that has grown may twist. With 0 a
    tube may be solved on one radius, which cannot twist."""

    def _faults(self) -> Faults:
        if self.kind == "elastic" and self.stiffness is None:
            yield "missing; a support of kind 'elastic' needs it, as in '10 kPa/mm'", "stiffness", None


class Supports(Table):
    """How the body is held. A body of your own has a table for each face that is held. A tube may have
    `[supports.outer]`, for what surrounds it.
    """

    further = Support
    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Support] = Field(init=False)

    ends: str = Field(default="free", json_schema_extra={"allowed": "'free', for a tube also 'clamped' and 'closed'"})
    """What holds the ends of a tube. 'free': they stay in their planes and may move radially. 'clamped': they also keep
    their circles. 'closed': they are free and have caps on which the pressure acts; the length is then an unknown."""

    @property
    def faces(self) -> dict[str, Support]:
        """Supports by name of the face."""
        return dict(self.__pydantic_extra__ or {})


# ---------------------------------------------------------------- tissue and cells


class Material(Table):
    """The tissue: an isotropic matrix (Lame constants) with a network of collagen chains.

    Its keyword arguments are the keys of `[material]` in a scene (docs/scene.md; paper, eqs. 2 to 4). Stresses are in
    `stress_unit`, lengths of chains in link lengths, `chain_density` in 1/m^3, `temperature` in kelvin.

    Raises
    ------
    SceneError
        If a value is not allowed: one line.

    Examples
    --------
    The paper's tissue, in kPa:

    >>> from remodel_fenicsx import parts
    >>> material = parts.Material(lame_lambda=27.293, lame_mu=3.103, chain_density=7e21, contour_length=2.125,
    ...                           persistence_length=1.82, temperature=310.0)
    >>> round(material.network_modulus, 3)  # c of docs/theory.md
    4.116
    >>> tissue = material.tissue(end_to_end_length=1.0)
    >>> tissue.contour_length
    2.125
    """

    lame_lambda: Annotated[float, STRESS] = Field(default=27.293, ge=0)
    """First Lame constant lambda of the matrix, in stress_unit."""
    lame_mu: Annotated[float, STRESS] = Field(default=3.103, gt=0)
    """Second Lame constant mu of the matrix, in stress_unit."""
    chain_density: Annotated[float, NUMBER_DENSITY] = Field(default=2.0e21, ge=0)
    """Number n_chn of chains per volume, in 1/m^3. 0 means no chains."""
    contour_length: float = Field(default=1.594, gt=0)
    """Contour length L of a chain, its length when pulled straight, in link lengths. The chain locks there."""
    persistence_length: float = Field(default=1.365, gt=0)
    """Persistence length A_p of a chain, in link lengths: its bending stiffness over k theta."""
    initial_stiffness: Annotated[float | None, STRESS] = Field(default=None, gt=0)
    """In place of chain_density: the slope of a measured curve at stretch 1, nominal stress of the network over stretch
    along aligned chains, in stress_unit (docs/which_numbers.md)."""
    locking_stretch: float | None = Field(default=None, gt=1)
    """In place of contour_length: the stretch L / r0 at which aligned chains lock (docs/which_numbers.md)."""
    temperature: Annotated[float, TEMPERATURE] = Field(default=310.0, gt=0)
    """Absolute temperature theta, in K."""
    energy_factor: Annotated[int, OneOf((1, 4))] = 1
    """Factor omega of the chain energy. 1: the stress as printed (eq. 7). 4: the energy as printed (eq. 4b)."""
    matrix: Annotated[str, OneOf(MATRICES)] = "neo-hookean"
    """Energy of the matrix."""
    chain: Annotated[str, OneOf(CHAINS)] = "wormlike"
    """Force law of a single chain."""
    repulsion: Annotated[str, OneOf(REPULSIONS)] = "axes"
    """Repulsive energy, which makes the reference state free of stress. 'axes': the paper's, in the stretches along the
    cell axes. 'log': of the structure tensor alone (A : ln C); the default with the law 'tensor'. 'length': of the
    length of the chains alone."""
    stress_unit: Annotated[str, OneOf(STRESS_UNITS)] = "Pa"
    """Unit of every stress of the scene. Forces are in this unit times the unit of length squared."""

    @property
    def tells_volume_apart(self) -> bool:
        """Whether the volumetric part of the matrix is known."""
        return isinstance(MATRICES[self.matrix], Matrix)

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
            self._part(CHAINS[self.chain]) if self.chain_density > 0 else None,
            self._part(MATRICES[self.matrix]),
            self._part(REPULSIONS[self.repulsion]),
        )

    def _part(self, part: Any) -> Any:
        """With the values of its own keys."""
        own = getattr(part, "parameters", None)
        return part.of({name: getattr(self, name, own[name].default) for name in own}) if own else part

    def summary(self, loads: Mapping[str, float]) -> str:
        """Stiffness of network and matrix and the loads, in one unit and on one line.

        Parameters
        ----------
        loads
            Stresses by the words for them, in stress_unit.
        """
        stresses = {"network modulus c =": self.network_modulus, "shear modulus mu =": self.lame_mu, **loads}
        return ", ".join(f"{words} {value:.4g} {self.stress_unit}" for words, value in stresses.items())


class Prestretch(Table):
    """How far a part of the wall was stretched before it was joined to the rest, along its local axes.

    Stretches that are left out keep the volume; two that are left out are equal.
    """

    circumferential: float | None = Field(default=None, gt=0)
    """Stretch around the body."""
    axial: float | None = Field(default=None, gt=0)
    """Stretch along the body."""
    radial: float | None = Field(default=None, gt=0)
    """Stretch across the wall."""

    def _faults(self) -> Faults:
        if not _set(self):
            yield "needs one of " + ", ".join(type(self).model_fields), "", self

    @property
    def stretches(self) -> tuple[float, float, float]:
        """Around, along and across."""
        given = (self.circumferential, self.axial, self.radial)
        known = math.prod(value for value in given if value is not None)
        around, along, across = (known ** (-1 / given.count(None)) if value is None else value for value in given)
        return around, along, across


_From: Any = with_key(
    "from", float, default=0.0, ge=0, lt=1, description="Where it begins, from the inside (0) to the outside (1)."
)


class NaturalLayer(_From):  # type: ignore[misc]
    """A part of the wall that was stretched before it was joined to the rest (docs/tissue_that_lives.md)."""

    to: float = Field(default=1.0, gt=0, le=1)
    """Where it ends."""
    region: str | None = Field(default=None, min_length=1, json_schema_extra={"allowed": "the name of a region"})
    """Name of a region, in place of `from` and `to`."""
    prestretch: Prestretch
    """Stretches from the layer's natural state to the unloaded body."""

    def _faults(self) -> Faults:
        low, high = self.share
        if not low < high:
            yield f"must be smaller than to = {shown(high)}", "from", low
        if self.region is not None and self.share != (0.0, 1.0):
            yield "a layer with a region takes no from and to", "region", self.region

    @property
    def share(self) -> tuple[float, float]:
        """Of the wall: where it begins and ends."""
        return getattr(self, "from"), self.to


AS_GIVEN: Literal["as-given"] = "as-given"


class Natural(Table):
    """The configuration in which the tissue is free of stress, if that is not the mesh (docs/tissue_that_lives.md)."""

    opening_angle: float = Field(default=0.0, ge=0, le=180)
    """For a tube: how far a cut ring opens, the angle of the missing sector in degrees. Fung's opening angle is half of
    it. 0: the tissue of the mesh is free of stress."""
    layers: Annotated[tuple[NaturalLayer, ...], IN_A_LIST] = Field(
        default=(), json_schema_extra={"allowed": "a list of tables, each [[natural.layers]]"}
    )
    """Parts of the wall that were stretched before they were joined, a table `[[natural.layers]]` each. A tube of such
    layers is closed so that it is in equilibrium without loads. A body of your own
    deforms at the start, until its layers balance."""

    cells: Literal["as-given", "equilibrium"] = AS_GIVEN
    """Cells of a tube whose geometry is the loaded one (geometry.is). 'as-given': those of [cells]. 'equilibrium':
    those that remodeling comes to under these loads; it needs time.end = 'equilibrium'."""

    fibres: bool | None = Field(default=None, json_schema_extra={"allowed": "true or false"})
    """Whether the run begins with what the file of cells.fibres has beside the cells, as `export` writes it:
    prestretch, content, natural length and growth. A file with any is refused where this is not said."""

    @property
    def is_of_the_mesh(self) -> bool:
        """Whether the mesh is free of stress."""
        return self.opening_angle == 0.0 and not self.layers and not self.fibres

    def _faults(self) -> Faults:
        for (_, other), (index, layer) in itertools.combinations(enumerate(self.layers), 2):
            if (layer.region is None) != (other.region is None):
                rule = "some layers have a region and some a share of the wall: allowed is one kind"
                yield rule, f"layers[{index}].region", layer.region
            meet = layer.share[0] < other.share[1] and other.share[0] < layer.share[1]  # with regions all do
            if meet and layer.region == other.region:
                yield "lies in another layer", f"layers[{index}]", layer.region or list(layer.share)


SAME_DRAWS = 3  # antithetic seeds: over as many turns of l_1, l_2, l_3 the mean of A is isotropic in each element


_Length = Annotated[float, Field(ge=0)]
_Lengths = Annotated[tuple[_Length, _Length, _Length], IN_A_LIST]
InitialCells = Literal["random", "isotropic", "aligned", "fibres"] | _Lengths


class Cells(Table):
    """The orthotropic unit cells of the collagen network before the first remodeling pass.

    Its keyword arguments are the keys of `[cells]` in a scene (docs/scene.md); lengths are in link lengths. Fig. 2 of
    the paper shows such a cell.

    Raises
    ------
    SceneError
        If a value is not allowed: one line.

    Examples
    --------
    >>> from remodel_fenicsx import parts
    >>> parts.Cells(initial="isotropic", end_to_end_length=1.0).dimensions(2).round(4)
    array([[0.5774, 0.5774, 0.5774],
           [0.5774, 0.5774, 0.5774]])
    >>> parts.Cells(initial="random", seed=7).dimensions(1000).shape
    (1000, 3)
    """

    initial: InitialCells = Field(
        default="random",
        json_schema_extra={"allowed": "'random', 'isotropic', 'aligned', 'fibres' or three lengths [l1, l2, l3]"},
    )
    """Cell dimensions l_I at t = 0, with |l| = end_to_end_length. 'random': one draw per element, uniform on the
    positive octant of the sphere. 'isotropic': three equal ones. 'aligned': all along aligned_axis. 'fibres': those of
    the file cells.fibres. [l1, l2, l3]: these, in link lengths."""
    fibres: str | None = Field(
        default=None, min_length=1, json_schema_extra={"allowed": "the name of a file .vtu, .xdmf or .csv"}
    )
    """File of measured fibres, relative to the scene: axes and dimensions of the cells at t = 0 (docs/my_own_vessel.md,
    Measured fibres in)."""
    fibres_sha256: str | None = Field(
        default=None, pattern="^[0-9a-f]{64}$", json_schema_extra={"allowed": "64 hexadecimal digits"}
    )
    """SHA-256 of that file. A scene as run has it, and refuses another file."""
    axes: Annotated[str, OneOf(AXES)] = "global"
    """Cell axes n_I before the first pass. 'global': x, y, z. 'cylindrical': circumferential, axial, radial, about the
    z axis. 'local': the same, found on a mesh (docs/my_own_vessel.md). Where nothing names them, a tube has
    'cylindrical'."""
    aligned_axis: Annotated[int, OneOf((1, 2, 3))] = 3
    """Number of the axis that 'aligned' cells lie along: x, y, z, or circumferential, axial, radial."""
    seed: int = Field(default=1, ge=0)
    """Seed of the random cells. The same seed and mesh give the same cells on any number of ranks."""
    antithetic: bool = False
    """Random cells: seeds 1 to 3 share one draw, with l_1, l_2 and l_3 in turn, and so do 4 to 6. Means over whole
    threes scatter less."""
    end_to_end_length: float = Field(default=1.0, gt=0)
    """Length r0 of a chain at t = 0, in link lengths, smaller than material.contour_length. It stays in the repulsive
    energy while the cells remodel."""

    def _faults(self) -> Faults:
        if (rule := self.fault_of_length()) is not None:
            yield rule, "initial", self.initial

    def fault_of_length(self) -> str | None:
        """What keeps three lengths from being those of a chain; None if nothing does."""
        length = self.end_to_end_length if isinstance(self.initial, str) else math.hypot(*self.initial)
        if abs(length - self.end_to_end_length) <= 1e-6 * self.end_to_end_length:
            return None
        r0 = shown(self.end_to_end_length)
        return f"the root of the sum of squares is {length:.7g}, it must be cells.end_to_end_length = {r0}"

    def dimensions(self, number_of_elements: int) -> NDArray[np.float64]:
        """l_I at t = 0 of every element of the mesh file, shape (number_of_elements, 3), in link lengths.

        The whole list of random cells is drawn on every rank, in the mesh file's order: the same element gets the same
        draw for any number of ranks.
        """
        r0 = self.end_to_end_length
        if self.initial == "random":
            seed, turn = divmod(self.seed + 2, SAME_DRAWS) if self.antithetic else (self.seed, 0)
            draws = np.abs(np.random.default_rng(seed).standard_normal((number_of_elements, 3)))
            draws = np.roll(draws, turn, axis=1)
            return r0 * draws / np.linalg.norm(draws, axis=1, keepdims=True)
        lengths: Any = self.initial
        if self.initial == "isotropic":
            lengths = [r0 / np.sqrt(3)] * 3
        elif self.initial == "aligned":
            lengths = [r0 if axis == self.aligned_axis else 0.0 for axis in (1, 2, 3)]
        return np.tile(np.array(lengths), (number_of_elements, 1))


@dataclass(frozen=True)
class CouplingKind:
    """How equilibrium and remodeling of one step are coupled, as scenes know it.

    Attributes
    ----------
    meaning
        What it does, for docs/scene.md.
    coupling
        The class of the `Coupling`, or its dotted name: scenes are read without dolfinx, which it needs.
    makes_a_share
        Whether it makes the share `relaxation_factor` of a pass.
    takes_cases
        Whether it solves several load cases with the same cells.
    takes_turnover
        Whether it changes content and natural length of the collagen (`[remodeling.turnover]`).
    needs_a_target
        Whether it is for laws with a target alone (`Law.target`).
    solves_cells
        Whether a solve finds the cells too: then it takes steps of any length.
    missing
        What a scene lacks for it, from the scene, in words; None where nothing.

    Examples
    --------
    A coupling whose cells wait until t = 1:

    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> from remodel_fenicsx.extend import COUPLINGS, CouplingKind, Staggered
    >>> class Late(Staggered):
    ...     def remodel(self, time):
    ...         return super().remodel(time) if time > 1.0 else 0.0
    >>> COUPLINGS["late"] = CouplingKind("as staggered, but the cells stay as they are up to t = 1", Late)
    >>> late = {"remodeling.coupling": "late", "time.end": 3.0}
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube").with_values(late)
    >>> [round(step.row["mean_fibre_angle"], 2) for step in Simulation(scene).steps()]
    [54.74, 54.74, 52.41]
    >>> del COUPLINGS["late"]
    """

    meaning: str
    coupling: Callable[..., Any] | str
    makes_a_share: bool = False
    needs_a_target: bool = False
    takes_cases: bool = False
    takes_turnover: bool = False
    solves_cells: bool = False
    missing: Callable[[Any], str | None] | None = None

    @property
    def make(self) -> Callable[..., Any]:
        """Makes the coupling of a state, a tissue, a remodeling pass and settings of the solver."""
        return resolved(self.coupling)


IMPLICIT = "implicit"
IN_ITS_PLACE = "take 'extrapolated' with remodeling.law = 'tensor', or 'staggered' with smaller steps"


def _refuse_implicit(*parts: object) -> NoReturn:
    text = f"this run can only be continued by version 0.4.0; {IN_ITS_PLACE}"
    raise SceneError(f"remodeling.coupling = {IMPLICIT!r}: {text}")


COUPLINGS = {
    "staggered": CouplingKind(
        "solve with the cells of the step before, then remodel once",
        "remodel_fenicsx.evolution.coupling:Staggered",
        takes_cases=True,
        takes_turnover=True,
    ),
    "relaxed": CouplingKind(
        "as 'staggered', but only the share relaxation_factor of each change is made, for drivers with which "
        "'staggered' over-corrects",
        "remodel_fenicsx.evolution.coupling:Staggered",
        makes_a_share=True,
        takes_cases=True,
        takes_turnover=True,
    ),
    "extrapolated": CouplingKind(
        "first remodel towards the stress expected at the middle of the step, then solve; of second order, for the "
        "law 'tensor'",
        "remodel_fenicsx.evolution.coupling:Extrapolated",
        needs_a_target=True,
        takes_cases=True,
        takes_turnover=True,
    ),
    IMPLICIT: CouplingKind(
        "",  # it means nothing to new scenes; those of runs made with version 0.4.0 and before are read
        _refuse_implicit,
        takes_turnover=True,
        missing=lambda scene: None if scene.is_as_run else f"version 0.4.0; {IN_ITS_PLACE}",
    ),
}
"""Couplings by the name that a scene gives them."""


AT_REST = "rest"
_Start: Any = Annotated[float, Field(ge=0)] | Literal["rest"]
_WithStart: Any = with_key(
    "from",
    Annotated[Any, GetPydanticSchema(lambda _, handler: handler(_Start))],
    default=0.0,
    json_schema_extra={"allowed": "a finite number of at least 0, or 'rest'"},
    description="Time from which turnover adds volume; a step ends there. 0: always. 'rest', with time.end = "
    "'equilibrium': once the tissue rests under the loads before their last change.",
)


class Turnover(_WithStart):  # type: ignore[misc]
    """How collagen is removed, and deposited again under a stretch: not without `time` (docs/tissue_that_lives.md).

    For the law `tensor`.
    """

    time: float | None = Field(default=None, gt=0)
    """Time T in which collagen is turned over. Without it there is no turnover."""
    deposition_stretch: float = Field(default=1.1, gt=1)
    """Stretch lambda_h, over r0, under which new chains are deposited."""
    gain: float = Field(default=1.0, ge=0)
    """Gain k: how fast the amount of collagen follows the stress of the chains. 0 means that the amount stays."""
    rates: Annotated[str, OneOf(TURNOVER_RATES)] = "cauchy"
    """What amount and natural length follow. 'cauchy': the stress that a chain makes. 'tension': its force, as in
    version 0.3.0."""
    volume: float = Field(default=0.3, ge=0, le=1)
    """Share phi of the wall that collagen is at the start, or at `from`: what is made adds volume. 0: it does not."""
    growth: Literal["normal"] = "normal"
    """Where the room is made: across the wall."""

    @property
    def grows(self) -> bool:
        """Whether what is made takes room."""
        return self.is_on and self.volume > 0

    @property
    def starts_at_rest(self) -> bool:
        """Whether it does so from a rest on the path."""
        return bool(getattr(self, "from") == AT_REST)

    @property
    def start(self) -> float:
        """The time from which it does; without end where nobody knows it yet."""
        return math.inf if self.starts_at_rest else float(getattr(self, "from"))

    @property
    def rule(self) -> TurnoverRule:
        """For arrays."""
        assert self.time is not None
        return TurnoverRule(self.time, self.deposition_stretch, self.gain, TURNOVER_RATES[self.rates])

    @property
    def is_on(self) -> bool:
        """Whether there is any."""
        return self.time is not None

    def _faults(self) -> Faults:
        if self.time is None and self != Turnover.model_construct():
            yield "missing; turnover needs its time", "time", None


@dataclass(frozen=True)
class RemodelsKind:
    """Something that remodels beside the cells.

    Attributes
    ----------
    table
        Its keys, `[remodeling.NAME]` in a scene: a `Table` with a property `is_on`.
    part
        The class of the `Remodels`, made of state, tissue and `Remodeling`, or its dotted name.

    Examples
    --------
    demos/extensions/decaying_collagen.py has one in a file; all there are:

    >>> from remodel_fenicsx.extend import REMODELS
    >>> sorted(REMODELS)
    ['turnover']
    """

    table: type[Table]
    part: Callable[..., Any] | str

    @property
    def make(self) -> Callable[..., Any]:
        """Makes the part of a state, a tissue and a `Remodeling`."""
        return resolved(self.part)


REMODELS = {"turnover": RemodelsKind(Turnover, "remodel_fenicsx.evolution.turnover:TurnoverPass")}
"""What remodels beside the cells, by the name of its table in `[remodeling]`."""


class Remodeling(Table):
    """How the cells follow the load: driving tensor, evolution law, frame and speed.

    Its keyword arguments are the keys of `[remodeling]` in a scene (docs/scene.md; paper, eqs. 8 to 11); `kappa` is in
    1/time.

    Raises
    ------
    SceneError
        If a value is not allowed: one line.

    Examples
    --------
    >>> from remodel_fenicsx import parts
    >>> parts.Remodeling(driver="cauchy", law="explicit", frame="spatial", kappa=0.025).coupling
    'staggered'
    >>> parts.Remodeling(driver="heat", law="explicit", frame="spatial", kappa=0.025)
    Traceback (most recent call last):
        ...
    remodel_fenicsx.schema.tables.SceneError: driver = 'heat': allowed are 'cauchy', 'pk2', 'finger'
    """

    driver: Annotated[str, OneOf(DRIVERS)] = "cauchy"
    """Tensor whose positive eigenvalues the cells follow. 'cauchy': the Cauchy stress. 'pk2': the second
    Piola-Kirchhoff stress. 'finger': the Finger tensor b."""
    law: Annotated[str, OneOf(LAWS)] = "explicit"
    """How the cells change in time. 'explicit': eq. (11), in absolute time. 'rate': eq. (10). 'relaxation': dl/dt =
    kappa (r0 e - l), right for changing loads. 'tensor': 'relaxation' of the structure tensor, without ranks and axes;
    the default without a preset. 'rotation' (Remark 5): the dimensions stay. 'none': cells stay."""
    frame: Annotated[str, OneOf(FRAMES)] = "material"
    """Axes of the remodeled cells, for the drivers 'cauchy' and 'finger'. 'material': the fibres that the deformation
    carries onto the principal directions (objective). 'spatial': the principal directions themselves, as printed."""
    pairing: Annotated[str, OneOf(PAIRINGS)] = "sorted"
    """Which cell dimension follows which principal value. 'sorted': by rank, as printed; where two values cross, the
    cell turns by 90 degrees at once. 'continuous': each principal direction continues the axis that it overlaps
    most."""
    coupling: Annotated[str, OneOf(COUPLINGS, removed={IMPLICIT: IN_ITS_PLACE})] = Field(
        default="staggered",
        description=f"In which order a step solves and remodels. {meanings(COUPLINGS)}. The default with the law "
        "'tensor' is 'extrapolated' (docs/laws_and_couplings.md).",
    )
    relaxation_factor: float = Field(default=0.5, gt=0, le=1)
    """For the coupling 'relaxed': the share theta of a pass's change of the structure tensor that is made. With 1 it is
    'staggered'."""
    kappa: float = Field(default=0.025, ge=0)
    """Speed of remodeling, in 1/time. A difference fades like exp(-kappa t)."""
    half_life: float | None = Field(default=None, gt=0)
    """In place of kappa: the time after which half of a difference is left, ln 2 / kappa."""
    threshold: Annotated[float, STRESS] = Field(default=0.0, ge=0)
    """Principal stress s0 up to which a point does not remodel; above it kappa has the factor 1 - s0/s. For the law
    'tensor' and drivers that are stresses (docs/laws_and_couplings.md)."""
    exponent: float = Field(default=2.0, gt=0, le=16)
    """Exponent n of the target (D+)^n over its trace: 2 is the paper's, 1 that of netting analysis. For the law
    'tensor' (docs/laws_and_couplings.md)."""
    mean: Annotated[str, OneOf(MEANS_OF_CASES)] = Field(
        default="tensor",
        description="What the cells follow where there are several load cases ([[cases]]). "
        f"{meanings(MEANS_OF_CASES)} (docs/cycles.md).",
    )
    rotation_time: float = Field(default=40.0, gt=0)
    """For the law 'rotation': a small angle between fibre and tension fades like exp(-t / rotation_time)."""

    turnover: Turnover = Turnover()

    def warnings(self) -> list[str]:
        """A line on a law that a share of each pass makes slower."""
        law, share = LAWS[self.law], self.relaxation_factor
        if not COUPLINGS[self.coupling].makes_a_share or share == 1 or not law.remodels or law.of_absolute_time:
            return []
        return [
            f"remodeling.coupling = {self.coupling!r} makes a share of {share:g} of each pass, and the law "
            f"{self.law!r} does not make up for the rest: cells remodel at about {share:g} times the speed"
        ]

    @property
    def beside(self) -> list[RemodelsKind]:
        """What remodels beside the cells."""
        return [kind for name, kind in REMODELS.items() if (table := getattr(self, name, None)) and table.is_on]

    @property
    def own_parameters(self) -> dict[str, float]:
        """Values of the law's own keys."""
        return {name: getattr(self, name) for name in LAWS[self.law].parameters}

    def speed(self, kappa: float, temperature: float) -> float:
        """The kappa that acts, of one of a region and its temperature.

        Parameters
        ----------
        kappa, temperature
            Of the region, in 1/time and K.
        """
        speed = LAWS[self.law].speed
        return kappa if speed is None else float(speed(kappa, temperature, **self.own_parameters))

    @property
    def has_set_point(self) -> bool:
        """Whether exponent or threshold is another than the paper's."""
        return self.exponent != 2.0 or self.threshold != 0.0

    def _faults(self) -> Faults:
        law, driver, coupling = LAWS[self.law], DRIVERS[self.driver], COUPLINGS[self.coupling]
        able = named(LAWS, lambda law: law.takes_set_points)
        for key, plain in (("exponent", 2), ("threshold", 0)):
            if getattr(self, key) != plain and not law.takes_set_points:
                yield f"must be {plain} unless remodeling.law is {able}", key, getattr(self, key)
        if self.threshold and not driver.is_stress:
            drivers = named(DRIVERS, lambda driver: driver.is_stress)
            yield f"must be 0 unless remodeling.driver is a stress: {drivers}", "threshold", self.threshold
        if self.turnover.is_on and not law.takes_set_points:
            yield f"needs remodeling.law = {able}", "turnover", None
        if self.turnover.is_on and not coupling.takes_turnover:
            able = named(COUPLINGS, lambda kind: kind.takes_turnover)
            yield f"with remodeling.turnover must be one of: {able}", "coupling", self.coupling
        if coupling.needs_a_target and law.target is None:
            rule = f"needs a remodeling.law with a target that can be extrapolated: {laws_with_a_target()}"
            yield rule, "coupling", self.coupling


def laws_with_a_target() -> str:
    """The names of laws with a target, for an error."""
    return named(LAWS, lambda law: law.target is not None)


# ---------------------------------------------------------------- regions


def in_region(name: str) -> str:
    """Of a dotted key in a region, or in the whole body: what stands before."""
    return f"regions.{name}." if name else ""


class Properties(NamedTuple):
    """What holds in a region, or in the body beside its regions."""

    material: Material
    cells: Cells
    kappa: float

    @property
    def tissue(self) -> Tissue:
        """The tissue of these parameters."""
        return self.material.tissue(self.cells.end_to_end_length)


def _for_regions(table: type[Table], key: str, *names: str) -> Any:
    """A class with some keys of another table, each of which may be left out: the value of that table holds then."""
    fields: Any = {}
    for name in names:
        field = copy.copy(table.model_fields[name])
        field.default, field.description = None, f"As `{key}.{name}`, for this region. Default: that of the whole body."
        fields[name] = Optional[field.annotation], field
    return create_model(f"_Some_{key}", __base__=Table, **fields)


_SomeMaterial: Any = _for_regions(
    Material, "material", "lame_lambda", "lame_mu", "chain_density", "contour_length", "persistence_length",
    "initial_stiffness", "locking_stretch", "temperature", "matrix",
)  # fmt: skip
_SomeCells: Any = _for_regions(
    Cells, "cells", "initial", "fibres", "fibres_sha256", "aligned_axis", "end_to_end_length"
)
_SomeRemodeling: Any = _for_regions(Remodeling, "remodeling", "kappa", "half_life")


class RegionMaterial(_SomeMaterial):  # type: ignore[misc]
    """Keys of `[material]` that differ in the region. The other keys of `[material]` hold for the whole body.

    With `chain_density = 0` the region has no collagen: its angles are empty, and its cells stay. A region that has own
    numbers for a matrix of an extension names `matrix` too.
    """


class RegionCells(_SomeCells):  # type: ignore[misc]
    """Keys of `[cells]` that differ in the region. Axes and seed hold for the whole body."""


class RegionRemodeling(_SomeRemodeling):  # type: ignore[misc]
    """Keys of `[remodeling]` that differ in the region. The law holds for the whole body."""


class Region(Table):
    """A named part of the body with properties of its own, such as `[regions.media]`. Other properties are the body's.

    Regions of a tube are layers of its wall, in the order of their outer radii; together they are the wall. No element
    lies in two layers. NAME is a letter, then letters, digits and `_`. Keys of other tables stand after the region:
    `material.chain_density = 4e21` in `[regions.media]`.
    """

    outer_radius: Annotated[float | None, LENGTH] = Field(default=None, gt=0)
    """For a tube: the outer radius of the layer, in the scene's unit of length. The layer begins where the one inside
    of it ends. The outermost layer may leave it out."""
    material: Annotated[SerializeAsAny[RegionMaterial], KeysOfParts({"matrix": MATRICES}, True)] = RegionMaterial()
    cells: RegionCells = RegionCells()
    remodeling: RegionRemodeling = RegionRemodeling()

    def over(self, others: Properties) -> Properties:
        """What holds in the region, its own keys over these."""
        return Properties(
            others.material.model_copy(update=_set(self.material)),
            others.cells.model_copy(update=_set(self.cells)),
            others.kappa if self.remodeling.kappa is None else self.remodeling.kappa,
        )


def _set(table: Table) -> dict[str, object]:
    return {name: value for name, value in table if value is not None}


# ---------------------------------------------------------------- loads and time


Ramp = Annotated[
    tuple[Annotated[tuple[float, float], IN_A_LIST], ...],
    IN_A_LIST,
    Field(min_length=1),
]


class Load(Table):
    """A load by name: `force` of cube and tendon, `pressure` and `elongation` of a tube. One that is left out is zero.

    A body of your own (shapes `'mesh'`, `'solid'`) may have further loads under names of your choice, each on one of
    its faces. docs/scene.md lists the loads of each shape.
    """

    value: float
    """Full value, at factor 1. An elongation has no unit and is above -1."""
    ramp: Ramp = Field(json_schema_extra={"allowed": "a list of pairs [time, factor] with increasing times"})
    """Factor on the value over time, linear between pairs, constant before the first and after the last. Times up to
    time.end must be multiples of time.step; with time.tolerance a step ends at each."""

    kind: Literal["pressure", "displacement"] | None = None
    """For a further load of a body of your own: 'pressure' acts against the outward normal of the deformed face.
    'displacement' moves a face that is held, guided or sliding along its mean outward normal."""
    face: str | None = Field(default=None, min_length=1, json_schema_extra={"allowed": "the name of a face"})
    """For a further load of a body of your own: the face that it acts on."""

    def _faults(self) -> Faults:
        for index, (time, _) in enumerate(self.ramp):
            if time < 0:
                yield "must be at least 0, where the simulation starts", f"ramp[{index}][0]", time
            if index and time <= self.ramp[index - 1][0]:
                rule = f"must be later than the time {shown(self.ramp[index - 1][0])} of the entry before"
                yield rule, f"ramp[{index}][0]", time
        for given, missing in (("kind", "face"), ("face", "kind")):
            if getattr(self, given) is not None and getattr(self, missing) is None:
                yield f"missing; {given} = {shown(getattr(self, given))} needs it", missing, None

    def factor(self, time: float) -> float:
        """Factor on the value at a time: piecewise linear, held before the first and after the last pair."""
        times, factors = zip(*self.ramp, strict=True)
        hits = [corner for corner in times if math.isclose(time, corner)]  # exact at its own times
        return float(np.interp(hits[0] if hits else time, times, factors))

    @property
    def falls(self) -> bool:
        """Whether it is ever smaller than before, or changes its sign."""
        factors = [0.0, *(factor for _, factor in self.ramp)]
        return any(abs(new) < abs(old) or new * old < 0 for old, new in itertools.pairwise(factors))

    def largest(self, end: float) -> float:
        """The value of largest magnitude from time 0 to `end`, with its sign."""
        times = [end, *(time for time, _ in self.ramp if time < end)]
        return max((self.value * self.factor(time) for time in times), key=abs)


SUM_OF_WEIGHTS = 1e-9  # how far from 1 the weights of load cases may sum: rounding, and 1/3 with ten digits


class LoadCase(Table):
    """A load case of a cycle, such as diastole (docs/cycles.md): a share of the time and its loads.

    Every case is a state of its own, solved with the same cells. The cells follow a mean over the
    cases. The columns and fields of a run are those of the first case. The others have columns
    with their number, such as `inner_radius@2`.
    """

    weight: float = Field(gt=0, le=1)
    """Share of the time. The weights of all cases sum to 1."""
    loads: dict[str, float] = Field(
        default_factory=dict, json_schema_extra={"allowed": "a table of numbers by the names of loads"}
    )
    """Factor on each load by its name, beside the factor of its ramp. Loads that are not named have 1."""


class OnFace(NamedTuple):
    """Where a further load acts, and how."""

    face: str
    kind: str = "pressure"


def faces_of(loads: Mapping[str, object]) -> dict[str, OnFace]:
    """Of the further loads among a scene's by name, tables as they were read or as they are."""
    tables = {name: dict(load) for name, load in loads.items() if isinstance(load, (Mapping, Load))}
    return {
        name: OnFace(load["face"], "displacement" if load.get("kind") == "displacement" else "pressure")
        for name, load in tables.items()
        if isinstance(load.get("face"), str)
    }


EQUILIBRIUM = "equilibrium"
"""What `time.end` says where the way there is not asked for."""


_End: Any = Annotated[float, Field(gt=0)] | Literal["equilibrium"]


class Time(Table):
    """Simulated time, in the unit of 1/kappa. It starts at 0 with the unloaded body."""

    # a number for all who step through time; those who take the word ask `is_equilibrium` first
    end: Annotated[Any, GetPydanticSchema(lambda _, handler: handler(_End))] = Field(
        json_schema_extra={"allowed": "a finite number greater than 0, or 'equilibrium'"}
    )
    """Last time, a whole number of steps; with a tolerance any time. 'equilibrium': the state that remodeling comes to
    under the loads at the end of their ramps (docs/theory.md, Equilibrium at once)."""
    step: float = Field(default=1.0, gt=0)
    """Time between two remodeling passes. With a tolerance it is the first step."""
    tolerance: float | None = Field(
        default=None, gt=0, json_schema_extra={"allowed": "a number greater than 0, in degrees"}
    )
    """Steps are chosen so that the estimated error in time stays below this angle, in degrees: that of directions, and
    that of lengths (1 degree stands for 1.7 %; docs/theory.md, Error-controlled steps). With end = 'equilibrium'
    the default is 3 degrees, or 0.5 where a load falls."""

    def _faults(self) -> Faults:
        if self.is_equilibrium:
            return
        if self.step > self.end:
            yield f"must be at most time.end = {shown(self.end)}", "step", self.step
        if self.end / self.step > MOST_STEPS:
            rule = f"must be at least time.end / {MOST_STEPS} = {self.end / MOST_STEPS:.6g}"
            yield rule, "step", self.step
        self.check_hit(self.end, "end")

    def is_hit(self, time: float) -> bool:
        """Whether a step ends at a time, or may end there."""
        return self.tolerance is not None or math.isclose(time, round(time / self.step) * self.step)

    def check_hit(self, time: float, key: str) -> None:
        """Refuse a time at which no step ends."""
        if not self.is_hit(time):
            below = math.floor(time / self.step)
            nearest = f"{below * self.step:.12g} and {(below + 1) * self.step:.12g}"
            rule = f"must be a multiple of time.step = {shown(self.step)}; the nearest are {nearest}"
            raise fault(rule, key, time)

    @property
    def is_equilibrium(self) -> bool:
        """Whether the end is no time."""
        return bool(self.end == EQUILIBRIUM)

    @property
    def number_of_steps(self) -> int:
        """Number of steps from 0 to the end, the equilibrium is one; with a tolerance the run's own are others."""
        return 1 if self.is_equilibrium else round(self.end / self.step)

    @property
    def chooses(self) -> bool:
        """Whether the run chooses its steps; their number is not known then."""
        return self.tolerance is not None and not self.is_equilibrium

    def progress(self, number: int, time: float) -> float:
        """How many of `number_of_steps` are behind a step; where steps are chosen, by its time."""
        return time / self.step if self.chooses else number

    def in_words(self) -> str:
        """How it is divided."""
        if self.tolerance is None:
            return f"{self.number_of_steps} steps"
        return f"steps of an error below {self.tolerance:g} degrees"


# ---------------------------------------------------------------- solver and output


class Solver(Table):
    """Solution of the nonlinear problem of each step.

    Its keyword arguments are the keys of `[solver]` in a scene (docs/scene.md).

    Raises
    ------
    SceneError
        If a value is not allowed: one line.

    Examples
    --------
    >>> from remodel_fenicsx import parts
    >>> parts.Solver().relative_tolerance
    1e-10
    >>> parts.Solver(method="direct", maximum_iterations=50).maximum_iterations
    50
    >>> parts.Solver(method="guess")
    Traceback (most recent call last):
        ...
    remodel_fenicsx.schema.tables.SceneError: method = 'guess': allowed are 'auto', 'direct', 'lagged', 'iterative'
    """

    method: Annotated[str, OneOf(SOLVER_METHODS, (AUTO,), REMOVED)] = Field(
        default=AUTO,
        description=f"How the equations of each step are solved. 'auto' takes 'direct' up to {SMALL_BODY} "
        f"unknowns ({SMALL_REDUCTION} of a reduction), then 'lagged', and above {LARGE} 'iterative'. "
        f"{meanings(SOLVER_METHODS)} "
        "(docs/speed_and_accuracy.md).",
    )
    predictor: Literal["none", "autoregressive", "with-tolerance"] = "autoregressive"
    """Where Newton's method starts a step: 'none' at the displacement of the step before, 'autoregressive' at what the
    last increments let expect, 'with-tolerance' so where steps are chosen (time.tolerance) alone. The solutions are
    the same to the tolerance."""
    absolute_tolerance: Annotated[float, FORCE] = Field(default=0.0, ge=0)
    """A force: a step is solved when |R| <= absolute_tolerance + relative_tolerance |nodal forces|."""
    relative_tolerance: float = Field(default=1e-10, ge=0, lt=1)
    """Relative to the internal nodal forces; see absolute_tolerance."""
    maximum_iterations: int = Field(default=25, ge=1)
    """Newton iterations after which a step counts as failed."""
    maximum_halvings: int = Field(default=12, ge=0)
    """How often a failed step is halved before the run ends with an error."""
    unstable: Literal["warn", "stop"] = "warn"
    """What to do at an equilibrium that the body would leave. 'warn': say where, and go on. 'stop': look in every step,
    and end the run after the last stable one (exit code 3)."""
    petsc_options: dict[str, str | bool | int | float] = Field(
        default_factory=dict,
        json_schema_extra={"allowed": "a table with a string, a finite number, true or false for each option"},
    )
    """PETSc options that replace the method's, without the leading '-': snes_..., ksp_..., pc_... and mat_.... Options
    that run code or write files are refused."""

    def _faults(self) -> Faults:
        for name, value in self.petsc_options.items():
            key = f"petsc_options.{quoted(name)}"
            if not re.fullmatch(r"[A-Za-z]\w*", name):
                yield "not a PETSc option; write its name without the leading '-'", key, value
            if name in ("snes_rtol", "snes_atol", "snes_stol"):
                yield "has no effect; use solver.relative_tolerance, solver.absolute_tolerance", key, value
            if refused := fault_of_option(name, value):
                yield refused, key, value
        if self.absolute_tolerance == 0.0 and self.relative_tolerance == 0.0:
            yield "must be greater than 0 where absolute_tolerance is 0", "relative_tolerance", 0.0


FIELDS_BY_NAME = (
    "displacement", "deformation_gradient", "cauchy_stress", "cell_dimensions", "axis_1", "axis_2", "axis_3",
    "fibre_angle", "fibre_angle_unloaded", "fibre_angle_deformed", "chain_extension", *TURNED_OVER, GROWTH,
    NATURAL_GRADIENT, "region", "chains",
)  # fmt: skip
"""What `output.fields` may name (`results.fields`); "chains" are the lines of fields_chains.vtkhdf."""
REGION = "region"  # the field of bodies with regions
TURNOVER_POWER = "turnover_power"  # the column of bodies with turnover, beside means of what is turned over
GROWTH_COLUMNS = (GROWTH, "collagen_share")  # of bodies whose volume changes with turnover
UNLOADED = "fibre_angle_unloaded"  # the field of bodies whose tissue is free of stress in another configuration
NO_PRESTRETCH = (UNLOADED, NATURAL_GRADIENT)  # fields that bodies whose mesh is free of stress have not
CONSTANT_FIELDS = ("axis_c", "axis_a", "axis_r", "depth", "station")
"""What it may name beside: local axes of the elements, their depth and station, which do not change."""
ALL_FIELDS = (*FIELDS_BY_NAME, *CONSTANT_FIELDS)
_FieldName = Annotated[str, OneOf(ALL_FIELDS)]


class Output(Table):
    """What a run writes beside its history table."""

    fields: bool | Annotated[tuple[_FieldName, ...], IN_A_LIST] = Field(
        default=True,
        json_schema_extra={"allowed": "true, false or a list of: " + ", ".join(map(repr, ALL_FIELDS))},
    )
    """Fields to write for ParaView: true for all, false for none, or a list of names (docs/commands.md). 'chains'
    stands for the chain lines. Others are not computed."""
    columns: Annotated[tuple[str, ...], IN_A_LIST, AfterValidator(lambda names: tuple(dict.fromkeys(names)))] = Field(
        default=(), json_schema_extra={"allowed": "a list of names of columns"}
    )
    """Columns of the history (docs/commands.md). Those on request are added. Where any others are named, only those are
    measured, with time and loads."""
    every: int = Field(default=1, ge=1)
    """Write the fields of every n-th step, and of the last one."""
    times: Annotated[tuple[Annotated[float, Field(gt=0)], ...], IN_A_LIST] = Field(
        default=(), json_schema_extra={"allowed": "a list of increasing times above 0"}
    )
    """Times up to time.end that have a row and fields in any case. They must be multiples of time.step; with
    time.tolerance a step ends at each."""
    report: bool = True
    """Make a page of the run for a browser, report.html, at its end (docs/report.md)."""
    checkpoint: int | None = Field(default=None, ge=0)
    """Number of steps between two checkpoints; 0 means only at the end. Without it at most 10 minutes are lost, and
    checkpoints cost less than 5 % of the run."""

    def _faults(self) -> Faults:
        if any(later <= time for time, later in itertools.pairwise(self.times)):
            yield "times must increase", "times", self.times
