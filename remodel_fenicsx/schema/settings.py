"""Tables of a scene, one class each: keys with defaults, units, limits and meanings.

Source of the defaults of tissue and cells: E. Kuhl, G. A. Holzapfel, J. Mater. Sci. 42 (2007)
8811-8823; docs/model.md has the equations as implemented. A `Scene` (`scene.scene`) consists of
these tables.
"""

from __future__ import annotations

import copy
import itertools
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, NoReturn, Optional, get_args

import numpy as np
from pydantic import (
    AfterValidator,
    ConfigDict,
    Field,
    GetPydanticSchema,
    SerializeAsAny,
    create_model,
)

from remodel_fenicsx._renamed import with_old_names
from remodel_fenicsx._lazy import resolved
from remodel_fenicsx.fem.formulations import FORMULATIONS, NOT_LOCKING, STIFF_BULK
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.fem.solver_methods import (
    AUTO,
    MIN_MULTIGRID,
    REMOVED,
    MAX_DIRECT_3D,
    MAX_DIRECT_REDUCED,
    SOLVER_METHODS,
    option_problem,
)
from remodel_fenicsx.model.axes import AXES, GROWTH, NATURAL_GRADIENT
from remodel_fenicsx.model.chains import BOLTZMANN_CONSTANT, CHAINS
from remodel_fenicsx.model.drivers import DRIVERS, FRAMES
from remodel_fenicsx.model.energy import ELASTIN, MATRICES, Matrix, REPULSIONS, TURNED_OVER, Tissue
from remodel_fenicsx.model.laws import LAWS, MEANS_OF_CASES
from remodel_fenicsx.model.spectral import PAIRINGS
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.schema import processes
from remodel_fenicsx.schema.processes import ProcessTable
from remodel_fenicsx.schema.tables import (
    Faults,
    IN_A_LIST,
    KeysOfParts,
    OneOf,
    SceneError,
    Table,
    extended_table,
    validation_error,
    join_names,
    quoted,
    format_value,
    with_key,
)
from remodel_fenicsx.schema.units import (
    FORCE,
    FOUNDATION,
    LENGTH,
    NUMBER_DENSITY,
    STRESS,
    TEMPERATURE,
)

STRESS_UNITS = {"Pa": 1.0, "kPa": 1.0e3, "MPa": 1.0e6}  # in Pa
MEASURED_CELLS = "fibres"  # the value of cells.initial that selects the file cells.fibres
MOST_STEPS = 1_000_000
NAME = r"[A-Za-z][A-Za-z0-9_]{0,39}"  # name of a region or further load; column names contain it
LARGEST_MESH = 10_000_000  # hexahedra; Gmsh, which is serial, needs about 10 GB for them


def meanings(registry: Mapping[str, Any]) -> str:
    """Return the meanings of all entries of a registry, as one description."""
    return ". ".join(f"{name!r}: {part.meaning}" for name, part in registry.items() if part.meaning)


# ---------------------------------------------------------------- body and mesh


class Mesh(Table):
    """Finite elements of the body.

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
    remodel_fenicsx.schema.tables.SceneError: refinement = 0: must be an integer at least 1
    """

    refinement: int = Field(default=1, ge=1)
    """Factor on the paper's number of elements in every direction; 1 is the paper's mesh. More than
    10 million hexahedra, or as many split into tetrahedra, are rejected."""
    element: Literal["hexahedron", "tetrahedron"] = "hexahedron"
    """Shape of the elements."""
    degree: Annotated[int, OneOf((1, 2))] = 1
    """Polynomial degree of the displacement in an element: 1, as in the paper, or 2."""
    formulation: Annotated[str, OneOf(FORMULATIONS, (AUTO,))] = Field(
        default=AUTO,
        description=f"Treatment of the volume change in an element. 'auto' takes {NOT_LOCKING!r} "
        f"if lambda/mu exceeds {STIFF_BULK['hexahedron']:g} (tetrahedra of degree 2: "
        f"{STIFF_BULK['tetrahedron']:g}), unless something else needs 'displacement'. "
        f"{meanings(FORMULATIONS)} (docs/reliability.md).",
    )

    def _faults(self) -> Faults:
        pair = self.element, self.degree
        if self.formulation != AUTO and not FORMULATIONS[self.formulation].applies_to(*pair):
            able = join_names(FORMULATIONS, lambda formulation: formulation.applies_to(*pair))
            rule = f"must be {able} for elements {self.element!r} of degree {self.degree}"
            yield rule, "formulation", self.formulation


class Model(Table):
    """Choice of the unknowns that describe the deformation."""

    kinematics: Annotated[str, OneOf(KINEMATICS, (AUTO,))] = Field(
        default=AUTO,
        description="'auto' takes the cheapest one that is exact for the scene. "
        f"{meanings(KINEMATICS)} (docs/model.md, Kinematics).",
    )


class Support(Table):
    """Support of a face of a user-supplied body, such as `[supports.inlet]` of a `'mesh'`.

    NAME is a face of `geometry.faces`, or one that the file names. N is the mean outward normal of
    the face, or of each of its parts, in the reference configuration; c goes around the centre of
    the part. By default inlet and outlet are guided and all other faces are free. A tube has only
    `[supports.outer]`, for the tissue around it.
    """

    kind: Literal["guided", "sliding", "held", "elastic", "free"] = "guided"
    """'guided': the face stays in its plane and its circle stays centred, but may grow. 'sliding':
    the face stays in its plane. 'held': the face moves only along N, as loads.elongation
    prescribes. 'elastic': springs of fixed direction. 'free': the face has no support
    (docs/my_own_vessel.md, Supports)."""
    stiffness: Annotated[float | None, FOUNDATION] = Field(default=None, gt=0)
    """Force per area and displacement, in stress_unit over the scene's unit of length. Required for
    'elastic'. For 'guided' and 'sliding' the default is 1000 (lame_lambda + 2 lame_mu) over the
    wall's thickness."""
    tangential: float = Field(default=1.0, ge=0, le=1)
    """For 'elastic': stiffness across N over stiffness along N. Below 0.5 a wall that has grown may
    twist. With 0 a tube may be solved on one radius, which cannot twist."""

    def _faults(self) -> Faults:
        if self.kind == "elastic" and self.stiffness is None:
            rule = "missing; a support of kind 'elastic' needs it, as in '10 kPa/mm'"
            yield rule, "stiffness", None


class Supports(Table):
    """Supports of the body.

    A user-supplied body has a table for each face with a support. A tube may have
    `[supports.outer]`, for the tissue around it.
    """

    further = Support
    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Support] = Field(init=False)

    ends: str = Field(
        default="free",
        json_schema_extra={"allowed": "'free', for a tube also 'clamped' and 'closed'"},
    )
    """Supports of a tube's ends. 'free': the ends stay in their planes and may move radially.
    'clamped': the ends also keep their circles. 'closed': the ends are free and have caps under the
    pressure; the length is then an unknown."""

    @property
    def faces(self) -> dict[str, Support]:
        """Supports by name of the face."""
        return dict(self.__pydantic_extra__ or {})


# ---------------------------------------------------------------- tissue and cells


_Stretch = Annotated[float, Field(gt=0)]


class Elastin(Table):
    """Prestretch of the matrix, which stands for elastin (docs/turnover.md, Elastin)."""

    prestretch: Annotated[tuple[_Stretch, _Stretch], IN_A_LIST] = Field(
        default=(1.0, 1.0), json_schema_extra={"allowed": "two numbers greater than 0"}
    )
    """Circumferential and axial stretch of elastin beyond that of collagen deposited at the start;
    its radial stretch keeps the volume. Fresh tissue stays stress-free. In the body's local axes:
    of a sheet x and y, of a cube or tendon y and the axis of the load, z."""


@with_old_names
class Material(Table):
    """Tissue: an isotropic matrix (Lame constants) with a network of collagen chains.

    Its keyword arguments are the keys of `[material]` in a scene (docs/scene.md; paper, eqs. 2
    to 4). Stresses are in `stress_unit`, lengths of chains in link lengths, `chain_density` in
    1/m^3, `temperature` in kelvin.

    Raises
    ------
    SceneError
        If a value is not allowed: one line.

    Examples
    --------
    The paper's tissue, in kPa:

    >>> from remodel_fenicsx import parts
    >>> material = parts.Material(
    ...     lame_lambda=27.293, lame_mu=3.103, chain_density=7e21, contour_length=2.125,
    ...     persistence_length=1.82, temperature=310.0,
    ... )
    >>> round(material.network_modulus, 3)  # c of docs/model.md
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
    """Contour length L of a chain, its length when pulled straight, in link lengths. The chain
    locks at L."""
    persistence_length: float = Field(default=1.365, gt=0)
    """Persistence length A_p of a chain, in link lengths: its bending stiffness over k theta."""
    initial_stiffness: Annotated[float | None, STRESS] = Field(default=None, gt=0)
    """Replaces chain_density: the slope of a measured curve at stretch 1, nominal stress of the
    network over stretch along aligned chains, in stress_unit (docs/concepts.md)."""
    locking_stretch: float | None = Field(default=None, gt=1)
    """Replaces contour_length: the stretch L / r0 at which aligned chains lock
    (docs/concepts.md)."""
    temperature: Annotated[float, TEMPERATURE] = Field(default=310.0, gt=0)
    """Absolute temperature theta, in K."""
    energy_factor: Annotated[int, OneOf((1, 4))] = 1
    """Factor omega of the chain energy. 1: the stress as printed (eq. 7). 4: the energy as printed
    (eq. 4b)."""
    matrix: Annotated[str, OneOf(MATRICES)] = "neo-hookean"
    """Energy of the matrix."""
    chain: Annotated[str, OneOf(CHAINS)] = "wormlike"
    """Force law of a single chain."""
    repulsion: Annotated[str, OneOf(REPULSIONS)] = "axes"
    """Repulsive energy, which makes the reference configuration stress-free. 'axes': the paper's,
    in the stretches along the cell axes. 'log': in the structure tensor only (A : ln C); the
    default with the law 'tensor'. 'length': in the length of the chains only."""
    stress_unit: Annotated[str, OneOf(STRESS_UNITS)] = "Pa"
    """Unit of every stress of the scene. Forces are in this unit times the unit of length
    squared."""
    elastin: Elastin = Elastin()

    @property
    def has_volumetric_split(self) -> bool:
        """Whether the matrix energy has a separate volumetric part."""
        return isinstance(MATRICES[self.matrix], Matrix)

    @property
    def network_modulus(self) -> float:
        """Network modulus c = omega k theta n_chn / (4 A_p), in stress_unit (default 1.568 Pa)."""
        pascal = (
            BOLTZMANN_CONSTANT
            * self.temperature
            * self.chain_density
            / (4 * self.persistence_length)
        )
        return self.energy_factor * pascal / STRESS_UNITS[self.stress_unit]

    def tissue(self, end_to_end_length: float) -> Tissue:
        """Return the tissue of these parameters, without chains if chain_density is 0.

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
            **(
                dict(zip(ELASTIN, self.elastin.prestretch, strict=True)) if self.has_elastin else {}
            ),
        )

    @property
    def has_elastin(self) -> bool:
        """Whether the matrix has a prestretch."""
        return self.elastin.prestretch != (1.0, 1.0)

    def _part(self, part: Any) -> Any:
        """Return a part with the values of its own parameters."""
        own = getattr(part, "parameters", None)
        return (
            part.with_parameters({name: getattr(self, name, own[name].default) for name in own})
            if own
            else part
        )

    def summary(self, loads: Mapping[str, float]) -> str:
        """Return the moduli of network and matrix and the loads, in one unit and on one line.

        Parameters
        ----------
        loads
            Stresses by their label, in stress_unit.
        """
        stresses = {
            "network modulus c =": self.network_modulus,
            "shear modulus mu =": self.lame_mu,
            **loads,
        }
        return ", ".join(
            f"{words} {value:.4g} {self.stress_unit}" for words, value in stresses.items()
        )


class Prestretch(Table):
    """Stretches of a layer before it was joined to the rest of the wall, along its local axes.

    Omitted stretches follow from constant volume; two omitted stretches are equal.
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
        """Circumferential, axial and radial stretch."""
        given = (self.circumferential, self.axial, self.radial)
        known = math.prod(value for value in given if value is not None)
        around, along, across = (
            known ** (-1 / given.count(None)) if value is None else value for value in given
        )
        return around, along, across


_From: Any = with_key(
    "from",
    float,
    default=0.0,
    ge=0,
    lt=1,
    description="Start of the layer, from the inside (0) to the outside (1).",
)


class NaturalLayer(_From):  # type: ignore[misc]
    """Layer that was stretched before it was joined to the wall (docs/turnover.md)."""

    to: float = Field(default=1.0, gt=0, le=1)
    """End of the layer."""
    region: str | None = Field(
        default=None, min_length=1, json_schema_extra={"allowed": "the name of a region"}
    )
    """Name of a region, instead of `from` and `to`."""
    prestretch: Prestretch
    """Stretches from the layer's stress-free configuration to the unloaded body."""

    def _faults(self) -> Faults:
        low, high = self.share
        if not low < high:
            yield f"must be smaller than to = {format_value(high)}", "from", low
        if self.region is not None and self.share != (0.0, 1.0):
            yield "must not be set together with from or to", "region", self.region

    @property
    def share(self) -> tuple[float, float]:
        """Start and end of the layer as normalised depth in the wall."""
        return getattr(self, "from"), self.to


AS_GIVEN: Literal["as-given"] = "as-given"


class Natural(Table):
    """Stress-free configuration, if it is not the mesh (docs/turnover.md)."""

    opening_angle: float = Field(default=0.0, ge=0, le=180)
    """For a tube: the angle of the missing sector of a cut ring, in degrees. Fung's opening angle
    is half of it. With 0 the tissue of the mesh is stress-free."""
    layers: Annotated[tuple[NaturalLayer, ...], IN_A_LIST] = Field(
        default=(), json_schema_extra={"allowed": "a list of tables, each [[natural.layers]]"}
    )
    """Prestretched layers of the wall, one table `[[natural.layers]]` each. A tube of such layers
    is closed so that it is in equilibrium without loads. A user-supplied body deforms at the start
    until its layers balance."""

    cells: Literal["as-given", "equilibrium"] = AS_GIVEN
    """Cells of a tube whose geometry is the loaded one (geometry.is). 'as-given': the cells of
    [cells]. 'equilibrium': the homeostatic cells under these loads; requires time.end =
    'equilibrium'."""

    fibres: bool | None = Field(default=None, json_schema_extra={"allowed": "true or false"})
    """Whether the run starts with the other data in the file of cells.fibres, as `export` writes
    it: prestretch, content, natural length and growth. A file with any of them is rejected if this
    is not set."""

    @property
    def is_trivial(self) -> bool:
        """Whether the tissue of the mesh is stress-free."""
        return self.opening_angle == 0.0 and not self.layers and not self.fibres

    def _faults(self) -> Faults:
        for (_, other), (index, layer) in itertools.combinations(enumerate(self.layers), 2):
            if (layer.region is None) != (other.region is None):
                rule = "must be set for all layers or for none"
                yield rule, f"layers[{index}].region", layer.region
            meet = (
                layer.share[0] < other.share[1] and other.share[0] < layer.share[1]
            )  # layers with regions all do
            if meet and layer.region == other.region:
                yield "overlaps another layer", f"layers[{index}]", layer.region or list(
                    layer.share
                )


# Size of a group of antithetic seeds. Over the three cyclic permutations of l_1, l_2, l_3 the mean
# of A is isotropic in each element.
ANTITHETIC_GROUP = 3


_Length = Annotated[float, Field(ge=0)]
_Lengths = Annotated[tuple[_Length, _Length, _Length], IN_A_LIST]
InitialCells = Literal["random", "isotropic", "aligned", "fibres"] | _Lengths


class Cells(Table):
    """Orthotropic unit cells of the collagen network before the first remodeling pass.

    Its keyword arguments are the keys of `[cells]` in a scene (docs/scene.md); lengths are in link
    lengths. Fig. 2 of the paper shows such a cell.

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
        json_schema_extra={
            "allowed": "'random', 'isotropic', 'aligned', 'fibres' or three lengths [l1, l2, l3]"
        },
    )
    """Cell dimensions l_I at t = 0, with |l| = end_to_end_length. 'random': one draw per element,
    uniform on the positive octant of the sphere. 'isotropic': three equal ones. 'aligned': all
    along aligned_axis. 'fibres': from the file cells.fibres. [l1, l2, l3]: these, in link
    lengths."""
    fibres: str | None = Field(
        default=None,
        min_length=1,
        json_schema_extra={"allowed": "the name of a file .vtu, .xdmf or .csv"},
    )
    """File of measured fibres, relative to the scene: axes and dimensions of the cells at t = 0
    (docs/my_own_vessel.md, Measured fibres in)."""
    fibres_sha256: str | None = Field(
        default=None,
        pattern="^[0-9a-f]{64}$",
        json_schema_extra={"allowed": "64 hexadecimal digits"},
    )
    """SHA-256 of the file cells.fibres. The scene that a run stores has it, and rejects another
    file."""
    fraction_x: float | None = Field(default=None, ge=0, le=1)
    """Fraction of the chains along the first axis, (l_1 / r0)^2: x, or circumferential in a wall.
    With fraction_y it replaces `initial`; the remainder lies along the third axis."""
    fraction_y: float | None = Field(default=None, ge=0, le=1)
    """Fraction of the chains along the second axis: y, or axial in a wall."""
    mean_angle: float = Field(default=0.0, ge=-360, le=360)
    """Angle from x to the first axis of the cells of a sheet at t = 0, towards y, in degrees. The
    strain of the sheet is then uniform."""
    axes: Annotated[str, OneOf(AXES)] = "global"
    """Cell axes n_I before the first pass. 'global': x, y, z. 'cylindrical': circumferential,
    axial, radial, about the z axis. 'local': the same, computed on a mesh (docs/my_own_vessel.md).
    The default of a tube is 'cylindrical'."""
    aligned_axis: Annotated[int, OneOf((1, 2, 3))] = 3
    """Number of the axis of 'aligned' cells: x, y, z, or circumferential, axial, radial."""
    seed: int = Field(default=1, ge=0)
    """Seed of the random cells. The same seed and mesh give the same cells on any number of
    ranks."""
    antithetic: bool = False
    """For random cells: seeds 1 to 3 share one draw, with l_1, l_2 and l_3 permuted cyclically, and
    so do seeds 4 to 6. Means over complete groups of three seeds scatter less."""
    end_to_end_length: float = Field(default=1.0, gt=0)
    """Length r0 of a chain at t = 0, in link lengths, smaller than material.contour_length. It
    stays in the repulsive energy while the cells remodel."""

    def _faults(self) -> Faults:
        if (rule := self.length_problem()) is not None:
            yield rule, "initial", self.initial
        x, y = self.fraction_x, self.fraction_y
        if (x, y) != (None, None) and (x is None or y is None or x + y > 1):
            yield "goes with fraction_x, and both have a sum of at most 1", "fraction_y", y

    def length_problem(self) -> str | None:
        """Return why `initial` contradicts `end_to_end_length`, or None if it does not."""
        length = (
            self.end_to_end_length if isinstance(self.initial, str) else math.hypot(*self.initial)
        )
        if abs(length - self.end_to_end_length) <= 1e-6 * self.end_to_end_length:
            return None
        r0 = format_value(self.end_to_end_length)
        return f"root of the sum of squares is {length:.7g}; must be cells.end_to_end_length = {r0}"

    def dimensions(self, number_of_elements: int) -> Array:
        """Return l_I at t = 0 of every element of the mesh file, in link lengths.

        The result has shape (number_of_elements, 3). Every rank draws the complete list of random
        cells in the mesh file's order. An element therefore has the same draw on any number of
        ranks. Cells that a file has are NaN.
        """
        r0 = self.end_to_end_length
        if self.initial == "random":
            seed, turn = (
                divmod(self.seed + 2, ANTITHETIC_GROUP) if self.antithetic else (self.seed, 0)
            )
            draws = np.abs(np.random.default_rng(seed).standard_normal((number_of_elements, 3)))
            draws = np.roll(draws, turn, axis=1)
            return r0 * draws / np.linalg.norm(draws, axis=1, keepdims=True)
        lengths: Any = self.initial
        if self.initial == "isotropic":
            lengths = [r0 / np.sqrt(3)] * 3
        elif self.initial == "aligned":
            lengths = [r0 if axis == self.aligned_axis else 0.0 for axis in (1, 2, 3)]
        elif self.initial == MEASURED_CELLS:
            lengths = [np.nan] * 3
        return np.tile(np.array(lengths), (number_of_elements, 1))


@with_old_names
@dataclass(frozen=True)
class CouplingKind:
    """Registry entry of a coupling of equilibrium and remodeling in one step.

    Attributes
    ----------
    meaning
        Description for docs/scene.md.
    coupling
        The class of the `Coupling`, or its dotted name. Scenes are read without dolfinx, which the
        class needs.
    relaxes
        Whether a pass makes only the fraction `relaxation_factor` of its change.
    takes_cases
        Whether the coupling solves several load cases with the same cells.
    takes_turnover
        Whether the coupling changes content and natural length of the collagen
        (`[remodeling.turnover]`).
    needs_a_target
        Whether the coupling requires a law with a target (`Law.target`).
    solves_cells
        Whether a solve also computes the cells. Steps may then have any size.
    missing
        Function that returns what a scene lacks for the coupling, as text, or None.

    Examples
    --------
    A coupling whose cells do not remodel until t = 1:

    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> from remodel_fenicsx.extend import COUPLINGS, CouplingKind, Staggered
    >>> class Late(Staggered):
    ...     def remodel(self, time):
    ...         return super().remodel(time) if time > 1.0 else 0.0
    >>> COUPLINGS["late"] = CouplingKind(
    ...     "as staggered, but the cells stay as they are up to t = 1", Late
    ... )
    >>> late = {"remodeling.coupling": "late", "time.end": 3.0}
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube").with_values(late)
    >>> [round(step.row["mean_fibre_angle"], 2) for step in Simulation(scene).steps()]
    [54.74, 54.74, 52.41]
    >>> del COUPLINGS["late"]
    """

    meaning: str
    coupling: Callable[..., Any] | str
    relaxes: bool = False
    needs_a_target: bool = False
    takes_cases: bool = False
    takes_turnover: bool = False
    solves_cells: bool = False
    missing: Callable[[Any], str | None] | None = None

    @property
    def make(self) -> Callable[..., Any]:
        """Constructor of the coupling, from state, tissue, remodeling pass and solver settings."""
        return resolved(self.coupling)


IMPLICIT = "implicit"
IN_ITS_PLACE = (
    "take 'extrapolated' with remodeling.law = 'tensor', or 'staggered' with smaller steps"
)


def _refuse_implicit(*parts: object) -> NoReturn:
    text = f"only version 0.4.0 can continue this run; for a new run {IN_ITS_PLACE}"
    raise SceneError(f"remodeling.coupling = {IMPLICIT!r}: {text}")


COUPLINGS = {
    "staggered": CouplingKind(
        "solve with the cells of the step before, then remodel once",
        "remodel_fenicsx.evolution.coupling:Staggered",
        takes_cases=True,
        takes_turnover=True,
    ),
    "relaxed": CouplingKind(
        "as 'staggered', but each pass makes only the fraction relaxation_factor of its change; "
        "for drivers with which 'staggered' overshoots",
        "remodel_fenicsx.evolution.coupling:Staggered",
        relaxes=True,
        takes_cases=True,
        takes_turnover=True,
    ),
    "extrapolated": CouplingKind(
        "first remodel towards the stress extrapolated to the middle of the step, then solve; "
        "second-order accurate, for the law 'tensor'",
        "remodel_fenicsx.evolution.coupling:Extrapolated",
        needs_a_target=True,
        takes_cases=True,
        takes_turnover=True,
    ),
    IMPLICIT: CouplingKind(
        "",  # only scenes of runs by version 0.4.0 and earlier may name it; they are still read
        _refuse_implicit,
        takes_turnover=True,
        missing=lambda scene: None if scene.is_as_run else f"version 0.4.0; {IN_ITS_PLACE}",
    ),
}
"""Couplings by their name in a scene."""


EQUILIBRIUM = "equilibrium"
"""Value of `time.end` that requests the homeostatic state without the history."""


@dataclass(frozen=True)
class RemodelsKind:
    """Registry entry of a quantity that remodels in addition to the cells.

    Attributes
    ----------
    table
        Keys of `[remodeling.NAME]` in a scene: a `Table` with a property `is_on`.
    part
        The class of the `Remodels`, constructed from state, tissue and `Remodeling`, or its dotted
        name.

    Examples
    --------
    demos/extensions/decaying_collagen.py adds one from a file. The registered names are:

    >>> from remodel_fenicsx.extend import REMODELS
    >>> sorted(REMODELS)
    ['turnover']
    """

    table: type[Table]
    part: Callable[..., Any] | str

    @property
    def make(self) -> Callable[..., Any]:
        """Constructor of the `Remodels`, from state, tissue and `Remodeling`."""
        return resolved(self.part)


REMODELS = {name: RemodelsKind(table, table.process) for name, table in processes.tables().items()}
"""Quantities that remodel in addition to the cells, by the name of their `[remodeling]` table."""


@with_old_names
class Remodeling(Table):
    """Evolution of the cells under load: driving tensor, evolution law, frame and rate.

    Its keyword arguments are the keys of `[remodeling]` in a scene (docs/scene.md; paper, eqs. 8
    to 11); `kappa` is in 1/time.

    Raises
    ------
    SceneError
        If a value is not allowed: one line.

    Examples
    --------
    >>> from remodel_fenicsx import parts
    >>> parts.Remodeling(driver="cauchy", law="explicit", frame="spatial", kappa=0.025).coupling
    'staggered'
    >>> parts.Remodeling(driver="b", law="explicit", frame="spatial", kappa=0.025)
    Traceback (most recent call last):
        ...
    remodel_fenicsx.schema.tables.SceneError: driver = 'b': must be one of 'cauchy', 'pk2', 'finger'
    """

    driver: Annotated[str, OneOf(DRIVERS)] = "cauchy"
    """Tensor whose positive eigenvalues the cells follow. 'cauchy': the Cauchy stress. 'pk2': the
    second Piola-Kirchhoff stress. 'finger': the Finger tensor b."""
    law: Annotated[str, OneOf(LAWS)] = "explicit"
    """Evolution law of the cells. 'explicit': eq. (11), in absolute time. 'rate': eq. (10).
    'relaxation': dl/dt = kappa (r0 e - l), right for changing loads. 'tensor': 'relaxation' of the
    structure tensor, without sorted dimensions and axes; the default without a preset. 'rotation'
    (Remark 5): the dimensions are constant. 'none': the cells are constant."""
    frame: Annotated[str, OneOf(FRAMES)] = "material"
    """Axes of the remodeled cells, for the drivers 'cauchy' and 'finger'. 'material': the fibres
    that the deformation maps to the principal directions (objective). 'spatial': the principal
    directions themselves, as printed."""
    pairing: Annotated[str, OneOf(PAIRINGS)] = "sorted"
    """Assignment of cell dimensions to principal values. 'sorted': by order, as printed; if two
    values cross, the cell rotates by 90 degrees in one step. 'continuous': each principal direction
    continues the axis with which it overlaps most."""
    coupling: Annotated[str, OneOf(COUPLINGS, removed={IMPLICIT: IN_ITS_PLACE})] = Field(
        default="staggered",
        description=f"Order of solve and remodeling pass in a step. {meanings(COUPLINGS)}. "
        "The default with the law 'tensor' is 'extrapolated' (docs/time_integration.md).",
    )
    relaxation_factor: float = Field(default=0.5, gt=0, le=1)
    """Relaxation factor theta of the coupling 'relaxed': the fraction of a pass's change of the
    structure tensor that is made. With 1 the coupling is 'staggered'."""
    kappa: float = Field(default=0.025, ge=0)
    """Rate of remodeling, in 1/time. A deviation from the target decays as exp(-kappa t)."""
    half_life: float | None = Field(default=None, gt=0)
    """Replaces kappa: the time after which half of a deviation from the target is left, ln 2 /
    kappa."""
    threshold: Annotated[float, STRESS] = Field(default=0.0, ge=0)
    """Principal stress s0 up to which a point does not remodel; above it kappa is multiplied by 1 -
    s0/s. For the law 'tensor' and drivers that are stresses (docs/time_integration.md)."""
    exponent: float = Field(default=2.0, gt=0, le=16)
    """Exponent n of the target (D+)^n over its trace: 2 is the paper's, 1 is that of netting
    analysis. For the law 'tensor' (docs/time_integration.md)."""
    mean: Annotated[str, OneOf(MEANS_OF_CASES)] = Field(
        default="tensor",
        description="Mean over several load cases ([[cases]]) that the cells follow. "
        f"{meanings(MEANS_OF_CASES)} (docs/load_cases.md, Load cases).",
    )
    rotation_time: float = Field(default=40.0, gt=0)
    """For the law 'rotation': a small angle between fibre and tension decays as exp(-t /
    rotation_time)."""

    def warnings(self) -> list[str]:
        """Return a warning if the coupling relaxes a law and thereby slows it down."""
        law, share = LAWS[self.law], self.relaxation_factor
        if (
            not COUPLINGS[self.coupling].relaxes
            or share == 1
            or not law.remodels
            or law.depends_on_absolute_time
        ):
            return []
        return [
            f"remodeling.coupling = {self.coupling!r} makes {share:g} of each pass, which the law "
            f"{self.law!r} does not make up: cells remodel at about {share:g} times the rate"
        ]

    @property
    def additional_kinds(self) -> list[RemodelsKind]:
        """Registry entries of the quantities that remodel in addition to the cells."""
        return [
            kind
            for name, kind in REMODELS.items()
            if (table := getattr(self, name, None)) and table.is_on
        ]

    @property
    def processes(self) -> list[ProcessTable]:
        """Tables of the processes in addition to the cells, also of inactive ones."""
        tables = (getattr(self, name, None) for name in REMODELS)
        return [table for table in tables if isinstance(table, ProcessTable)]

    @property
    def growth_key(self) -> str:
        """Dotted key with which the tissue grows; empty if its volume is constant."""
        growing = (process for process in self.processes if process.growth_key)
        return next((f"remodeling.{process.name}.{process.growth_key}" for process in growing), "")

    @property
    def own_parameters(self) -> dict[str, float]:
        """Values of the law's own keys by name."""
        return {name: getattr(self, name) for name in LAWS[self.law].parameters}

    def speed(self, kappa: float, temperature: float) -> float:
        """Return the effective kappa at a temperature, in 1/time.

        Parameters
        ----------
        kappa, temperature
            Values of a region, in 1/time and K.
        """
        speed = LAWS[self.law].speed
        return kappa if speed is None else float(speed(kappa, temperature, **self.own_parameters))

    @property
    def changes_exponent_or_threshold(self) -> bool:
        """Whether exponent or threshold differs from the paper's."""
        return self.exponent != 2.0 or self.threshold != 0.0

    def _faults(self) -> Faults:
        law, driver = LAWS[self.law], DRIVERS[self.driver]
        coupling = COUPLINGS[self.coupling]
        able = join_names(LAWS, lambda law: law.uses_exponent_and_threshold)
        for key, plain in (("exponent", 2), ("threshold", 0)):
            if getattr(self, key) != plain and not law.uses_exponent_and_threshold:
                yield f"must be {plain} unless remodeling.law is {able}", key, getattr(self, key)
        if self.threshold and not driver.is_stress:
            drivers = join_names(DRIVERS, lambda driver: driver.is_stress)
            rule = f"must be 0 unless remodeling.driver is a stress: {drivers}"
            yield rule, "threshold", self.threshold
        for name in (process.name for process in self.processes if process.is_on):
            if not law.uses_exponent_and_threshold:
                yield f"needs remodeling.law = {able}", name, None
            if not coupling.takes_turnover:
                names = join_names(COUPLINGS, lambda kind: kind.takes_turnover)
                yield f"must be one of {names} with remodeling.{name}", "coupling", self.coupling
        if coupling.needs_a_target and law.target is None:
            rule = "needs a remodeling.law with a target that can be extrapolated"
            yield f"{rule}: {laws_with_a_target()}", "coupling", self.coupling


if not TYPE_CHECKING:  # the tables of processes are keys of the table too
    Remodeling = extended_table(
        Remodeling, tuple((name, kind.table) for name, kind in REMODELS.items())
    )


def laws_with_a_target() -> str:
    """Return the names of laws with a target, for an error message."""
    return join_names(LAWS, lambda law: law.target is not None)


# ---------------------------------------------------------------- regions


def in_region(name: str) -> str:
    """Return the prefix of a region's dotted keys, or nothing for the whole body."""
    return f"regions.{name}." if name else ""


class Properties(NamedTuple):
    """Properties of a region, or of the body outside its regions."""

    material: Material
    cells: Cells
    kappa: float

    @property
    def tissue(self) -> Tissue:
        """Tissue of these parameters."""
        return self.material.tissue(self.cells.end_to_end_length)


def _for_regions(table: type[Table], key: str, *names: str) -> Any:
    """Create a table with some keys of another one, all optional; None takes that table's value."""
    fields: Any = {}
    for name in names:
        field = copy.copy(table.model_fields[name])
        field.default, field.description = (
            None,
            f"As `{key}.{name}`, for this region. Default: that of the whole body.",
        )
        fields[name] = Optional[field.annotation], field
    return create_model(f"_Some_{key}", __base__=Table, **fields)


_SomeMaterial: Any = _for_regions(
    Material,
    "material",
    "lame_lambda",
    "lame_mu",
    "chain_density",
    "contour_length",
    "persistence_length",
    "initial_stiffness",
    "locking_stretch",
    "temperature",
    "matrix",
    "elastin",
)
_SomeCells: Any = _for_regions(
    Cells, "cells", "initial", "fibres", "fibres_sha256", "aligned_axis", "end_to_end_length"
)
_SomeRemodeling: Any = _for_regions(Remodeling, "remodeling", "kappa", "half_life")


class RegionMaterial(_SomeMaterial):  # type: ignore[misc]
    """Keys of `[material]` that differ in the region. The other keys are the whole body's.

    With `chain_density = 0` the region has no collagen: its angles are empty, and its cells are
    constant. A region with its own parameters of an extension's matrix must name `matrix` too.
    """


class RegionCells(_SomeCells):  # type: ignore[misc]
    """Keys of `[cells]` that differ in the region. Axes and seed hold for the whole body."""


class RegionRemodeling(_SomeRemodeling):  # type: ignore[misc]
    """Keys of `[remodeling]` that differ in the region. The law holds for the whole body."""


class Region(Table):
    """Named part of the body with its own properties, such as `[regions.media]`.

    Properties that a region does not set are the body's. Regions of a tube are the layers of its
    wall, ordered by outer radius; together they fill the wall. No element lies in two layers. NAME
    is a letter, then letters, digits and `_`. Keys of other tables are written with the region as
    prefix: `material.chain_density = 4e21` in `[regions.media]`.
    """

    outer_radius: Annotated[float | None, LENGTH] = Field(default=None, gt=0)
    """For a tube: the outer radius of the layer, in the scene's unit of length. The layer begins at
    the outer radius of the next inner layer. The key is optional for the outermost layer."""
    material: Annotated[SerializeAsAny[RegionMaterial], KeysOfParts({"matrix": MATRICES}, True)] = (
        RegionMaterial()
    )
    cells: RegionCells = RegionCells()
    remodeling: RegionRemodeling = RegionRemodeling()

    def over(self, others: Properties) -> Properties:
        """Return the properties in the region: its own keys, completed by the body's."""
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


FaceKind = Literal["pressure", "displacement", "traction"]


class Load(Table):
    """Load by name: `force` of cube and tendon, `pressure` of a tube. Omitted loads are zero.

    A user-supplied body (shapes `'mesh'`, `'solid'`) may have further loads under names of your
    choice, each on one of its faces. docs/scene.md lists the loads of each shape.
    """

    value: float
    """Full value, at factor 1. An elongation has no unit and is greater than -1."""
    ramp: Ramp = Field(
        json_schema_extra={"allowed": "a list of pairs [time, factor] with increasing times"}
    )
    """Factor on the value over time, linear between pairs, constant before the first and after the
    last. Times up to time.end must be multiples of time.step. With time.tolerance a step ends at
    each time."""

    kind: FaceKind | None = None
    """For a further load of a user-supplied body: 'pressure' acts against the outward normal of the
    deformed face. 'displacement' moves a held, guided or sliding face along its mean outward
    normal. 'traction' is a dead load, a force per reference area in a fixed `direction`."""
    face: str | None = Field(
        default=None, min_length=1, json_schema_extra={"allowed": "the name of a face"}
    )
    """For a further load of a user-supplied body: the face on which the load acts."""
    direction: Annotated[tuple[float, float, float], IN_A_LIST] | None = Field(
        default=None, json_schema_extra={"allowed": "a list of three numbers, not all 0"}
    )
    """For a 'traction': its direction along x, y and z, of any length."""

    def _faults(self) -> Faults:
        for index, (time, _) in enumerate(self.ramp):
            if time < 0:
                yield "must be at least 0, the start of the simulation", f"ramp[{index}][0]", time
            if index and time <= self.ramp[index - 1][0]:
                rule = f"must exceed the previous entry's {format_value(self.ramp[index - 1][0])}"
                yield rule, f"ramp[{index}][0]", time
        if (self.direction is None) == (self.kind == "traction"):
            yield "must be set for kind = 'traction', and only for it", "direction", self.direction
        if self.direction is not None and not any(self.direction):
            yield "must not be 0", "direction", self.direction
        for given, missing in (("kind", "face"), ("face", "kind")):
            if getattr(self, given) is not None and getattr(self, missing) is None:
                rule = f"missing; {given} = {format_value(getattr(self, given))} needs it"
                yield rule, missing, None

    def factor(self, time: float) -> float:
        """Return the load factor at a time: piecewise linear, constant outside the ramp."""
        times, factors = zip(*self.ramp, strict=True)
        hits = [
            corner for corner in times if math.isclose(time, corner)
        ]  # exact at the ramp's times
        return float(np.interp(hits[0] if hits else time, times, factors))

    @property
    def decreases(self) -> bool:
        """Whether the load's magnitude ever decreases, or its sign changes."""
        factors = [0.0, *(factor for _, factor in self.ramp)]
        return any(abs(new) < abs(old) or new * old < 0 for old, new in itertools.pairwise(factors))

    def largest(self, end: float) -> float:
        """Return the value of largest magnitude from time 0 to `end`, with its sign."""
        times = [end, *(time for time, _ in self.ramp if time < end)]
        return max((self.value * self.factor(time) for time in times), key=abs)


SUM_OF_WEIGHTS = 1e-9  # tolerance for the sum of case weights: rounding, and 1/3 with ten digits


class LoadCase(Table):
    """Load case of a cycle, such as diastole: fraction of the time, and loads (docs/load_cases.md).

    Every case is a state of its own, solved with the same cells. The cells follow a mean over the
    cases. The columns and fields of a run are those of the first case. The further cases have
    columns with their number, such as `inner_radius@2`.
    """

    weight: float = Field(gt=0, le=1)
    """Fraction of the time. The weights of all cases sum to 1."""
    loads: dict[str, float] = Field(
        default_factory=dict,
        json_schema_extra={"allowed": "a table of numbers by the names of loads"},
    )
    """Factor on each load by its name, in addition to the factor of its ramp. The default is 1."""


class OnFace(NamedTuple):
    """Face and kind of a further load."""

    face: str
    kind: str = "pressure"


def faces_of(loads: Mapping[str, object]) -> dict[str, OnFace]:
    """Return face and kind of a scene's further loads by name, from validated tables or as read."""
    tables = {name: dict(load) for name, load in loads.items() if isinstance(load, (Mapping, Load))}
    return {
        name: OnFace(
            load["face"],
            str(load["kind"]) if load.get("kind") in get_args(FaceKind) else "pressure",
        )
        for name, load in tables.items()
        if isinstance(load.get("face"), str)
    }


_End: Any = Annotated[float, Field(gt=0)] | Literal["equilibrium"]


class Time(Table):
    """Simulated time, in the unit of 1/kappa. It starts at 0 with the unloaded body."""

    # Time stepping takes `end` as a number. Other code checks `is_equilibrium` first.
    end: Annotated[Any, GetPydanticSchema(lambda _, handler: handler(_End))] = Field(
        json_schema_extra={"allowed": "a finite number greater than 0, or 'equilibrium'"}
    )
    """End time, a multiple of time.step; with a tolerance any time. 'equilibrium': the homeostatic
    state under the loads at the end of their ramps (docs/solver.md, Homeostatic state)."""
    step: float = Field(default=1.0, gt=0)
    """Time between two remodeling passes. With a tolerance it is the first step size."""
    tolerance: float | None = Field(
        default=None, gt=0, json_schema_extra={"allowed": "a number greater than 0, in degrees"}
    )
    """Bound of the estimated time discretisation error, in degrees; step sizes then adapt to it.
    The error is that of directions, and that of lengths (1 degree corresponds to 1.7 %;
    docs/time_integration.md, Error-controlled steps). With end = 'equilibrium' the default is
    3 degrees, or 0.5 if a load decreases."""

    def _faults(self) -> Faults:
        if self.is_equilibrium:
            return
        if self.step > self.end:
            yield f"must be at most time.end = {format_value(self.end)}", "step", self.step
        if self.end / self.step > MOST_STEPS:
            rule = f"must be at least time.end / {MOST_STEPS} = {self.end / MOST_STEPS:.6g}"
            yield rule, "step", self.step
        self.check_step_time(self.end, "end")

    def check_step_time(self, time: float, key: str) -> None:
        """Check that a step may end at a time."""
        nearest_step = round(time / self.step) * self.step
        if self.tolerance is None and not math.isclose(time, nearest_step):
            below = math.floor(time / self.step)
            nearest = f"{below * self.step:.12g} and {(below + 1) * self.step:.12g}"
            rule = (
                f"must be a multiple of time.step = {format_value(self.step)}; "
                f"the nearest are {nearest}"
            )
            raise validation_error(rule, key, time)

    @property
    def is_equilibrium(self) -> bool:
        """Whether the run ends at the homeostatic state instead of a time."""
        return bool(self.end == EQUILIBRIUM)

    @property
    def number_of_steps(self) -> int:
        """Number of steps of size `step` to the end; 1 for the homeostatic state."""
        return 1 if self.is_equilibrium else round(self.end / self.step)

    @property
    def is_adaptive(self) -> bool:
        """Whether step sizes adapt to the tolerance, so that the number of steps is not known."""
        return self.tolerance is not None and not self.is_equilibrium

    def progress(self, number: int, time: float) -> float:
        """Return how many of `number_of_steps` are done; with adaptive steps by time."""
        return time / self.step if self.is_adaptive else number

    def in_words(self) -> str:
        """Describe the division into steps."""
        if self.tolerance is None:
            return f"{self.number_of_steps} steps"
        return f"steps with an error below {self.tolerance:g} degrees"


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
    >>> parts.Solver(unstable="ignore")
    Traceback (most recent call last):
        ...
    remodel_fenicsx.schema.tables.SceneError: unstable = 'ignore': must be one of 'warn', 'stop'
    """

    method: Annotated[str, OneOf(SOLVER_METHODS, (AUTO,), REMOVED)] = Field(
        default=AUTO,
        description=f"Solver of each step's equations. 'auto' takes 'direct' up to {MAX_DIRECT_3D} "
        f"unknowns ({MAX_DIRECT_REDUCED} of a reduction), then 'lagged', and above "
        f"{MIN_MULTIGRID} 'iterative' where a factorisation costs more. {meanings(SOLVER_METHODS)} "
        "(docs/reliability.md).",
    )
    predictor: Literal["none", "autoregressive", "with-tolerance"] = "autoregressive"
    """Start of Newton's method in a step. 'none': the displacement of the previous step.
    'autoregressive': a prediction from the last increments. 'with-tolerance': a prediction only
    in adaptive steps (time.tolerance) and on the path to the steady state (time.end =
    'equilibrium'). The solutions agree to the tolerance."""
    absolute_tolerance: Annotated[float, FORCE] = Field(default=0.0, ge=0)
    """A force: a step is solved if |R| <= absolute_tolerance + relative_tolerance |nodal
    forces|."""
    relative_tolerance: float = Field(default=1e-10, ge=0, lt=1)
    """Relative to the internal nodal forces; see absolute_tolerance."""
    maximum_iterations: int = Field(default=25, ge=1)
    """Newton iterations after which a solve counts as failed."""
    maximum_halvings: int = Field(default=12, ge=0)
    """Maximum number of bisections of a failed step before the run ends with an error."""
    unstable: Literal["warn", "stop"] = "warn"
    """Action at an unstable equilibrium, which a perturbed body would leave. 'warn': report it, and
    continue. 'stop': check every step, and end the run after the last stable one (exit code 3)."""
    petsc_options: dict[str, str | bool | int | float] = Field(
        default_factory=dict,
        json_schema_extra={
            "allowed": "a table with a string, a finite number, true or false for each option"
        },
    )
    """PETSc options that replace the method's, without the leading '-': snes_..., ksp_..., pc_...
    and mat_.... Options that run code or write files are rejected."""

    def _faults(self) -> Faults:
        for name, value in self.petsc_options.items():
            key = f"petsc_options.{quoted(name)}"
            if not re.fullmatch(r"[A-Za-z]\w*", name):
                yield "not a PETSc option; write its name without the leading '-'", key, value
            if name in ("snes_rtol", "snes_atol", "snes_stol"):
                rule = "has no effect; use solver.relative_tolerance, solver.absolute_tolerance"
                yield rule, key, value
            if refused := option_problem(name, value):
                yield refused, key, value
        if self.absolute_tolerance == 0.0 and self.relative_tolerance == 0.0:
            yield "must be greater than 0 if absolute_tolerance is 0", "relative_tolerance", 0.0


WALL_STRESSES = ("hoop_stress", "axial_stress")  # fields of bodies with a wall
STRESS_FIELDS = (*WALL_STRESSES, "max_principal_stress", "von_mises_stress")
FIELDS_BY_NAME = (
    "displacement",
    "deformation_gradient",
    "cauchy_stress",
    *STRESS_FIELDS,
    "cell_dimensions",
    "axis_1",
    "axis_2",
    "axis_3",
    "fibre_angle",
    "fibre_angle_unloaded",
    "fibre_angle_deformed",
    "chain_extension",
    *TURNED_OVER,
    GROWTH,
    NATURAL_GRADIENT,
    "region",
    "chains",
)
"""Names for `output.fields` (`results.fields`); "chains" are the lines of fields_chains.vtkhdf."""
REGION = "region"  # field of bodies with regions
UNLOADED = "fibre_angle_unloaded"  # field of bodies whose mesh is not stress-free
NO_PRESTRETCH = (UNLOADED, NATURAL_GRADIENT)  # fields that bodies with a stress-free mesh lack
CONSTANT_FIELDS = ("axis_c", "axis_a", "axis_r", "depth", "station")
"""Further names: the elements' local axes, depth and station, which are constant in time."""
ALL_FIELDS = (*FIELDS_BY_NAME, *CONSTANT_FIELDS)
_FieldName = Annotated[str, OneOf(ALL_FIELDS)]


class Output(Table):
    """Output of a run in addition to its history table."""

    fields: bool | Annotated[tuple[_FieldName, ...], IN_A_LIST] = Field(
        default=True,
        json_schema_extra={
            "allowed": "true, false or a list of: " + ", ".join(map(repr, ALL_FIELDS))
        },
    )
    """Fields to write for ParaView: true for all, false for none, or a list of names
    (docs/commands.md). 'chains' stands for the chain lines. Other fields are not computed."""
    columns: Annotated[
        tuple[str, ...], IN_A_LIST, AfterValidator(lambda names: tuple(dict.fromkeys(names)))
    ] = Field(default=(), json_schema_extra={"allowed": "a list of names of columns"})
    """Columns of the history (docs/commands.md). Columns on request are added to the default ones.
    If any other column is named, only the named columns are measured, with time and loads."""
    every: int = Field(default=1, ge=1)
    """Write the fields of every n-th step, and of the last one."""
    times: Annotated[tuple[Annotated[float, Field(gt=0)], ...], IN_A_LIST] = Field(
        default=(), json_schema_extra={"allowed": "a list of increasing times above 0"}
    )
    """Times up to time.end that have a row and fields in any case. They must be multiples of
    time.step. With time.tolerance a step ends at each."""
    report: bool = True
    """Write a page of the run for a browser, report.html, at its end (docs/commands.md)."""
    checkpoint: int | None = Field(default=None, ge=0)
    """Number of steps between two checkpoints; 0 means only at the end. By default at most 10
    minutes are lost, and checkpoints cost less than 5 % of the run."""

    def _faults(self) -> Faults:
        if any(later <= time for time, later in itertools.pairwise(self.times)):
            yield "times must increase", "times", self.times
