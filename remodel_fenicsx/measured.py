"""Measured fibres, and what an earlier run has left: from the files that a scene names to the points of a mesh."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.errors import UnreadableFile
from remodel_fenicsx.fem.assembly import agreed
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.model.axes import GROWTH, NATURAL_GRADIENT
from remodel_fenicsx.model.energy import TURNED_OVER
from remodel_fenicsx.model.tensors import Array, Flags
from remodel_fenicsx.scene import Scene, SceneError
from remodel_fenicsx.schema.settings import Cells, Turnover, in_region

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from remodel_fenicsx.body.fibres import FibreFile

log = logging.getLogger(__name__)

Fibres = Mapping[str, Mapping[str, Array]]  # measured: by region and name, a row for each element of the mesh
# what files of fibres may have beside the fibres, as it is at the start of a run
UNCHANGED: Mapping[str, ArrayLike] = {NATURAL_GRADIENT: np.eye(3), "content": 1.0, "natural_length": 1.0, GROWTH: 1.0}


def measured_fibres(scene: Scene, domain: Domain) -> dict[str, dict[str, Array]]:
    """Measured fibres by region and name, a row for each element of the mesh, on all ranks. Collective."""
    if not scene.measured_cells:
        return {}
    points, elements = domain.gather_mesh()
    regions = domain.gather_elements(domain.element_region)

    def read() -> dict[str, dict[str, Array]] | None:
        if points is None or elements is None or regions is None:
            return None
        found = {}
        for name, cells in scene.measured_cells.items():
            chosen = regions == domain.regions[name] if name else np.ones(len(regions), dtype=np.bool_)
            measured = _fibres_of(cells, name, points[elements], chosen)
            found[name] = _with_prestretch(measured, f"{in_region(name)}cells.fibres = {cells.fibres!r}", scene)
        return found

    return domain.comm.bcast(agreed(domain.comm, read)) or {}


def _with_prestretch(measured: dict[str, Array], key: str, scene: Scene) -> dict[str, Array]:
    """Measured fibres, with prestretch, content and natural length where the scene begins with those of the file."""
    wanted, held = scene.natural.fibres, [name for name in UNCHANGED if name in measured]
    changed = [name for name in held if not np.allclose(measured[name], np.reshape(UNCHANGED[name], -1))]
    if changed and wanted is None:
        rule = "set natural.fibres = true to begin with them, or false to leave them out"
        raise SceneError(f"{key}: has {', '.join(changed)} of an earlier run; {rule}")
    of_turnover = [name for name in TURNED_OVER if name in changed]
    if wanted and of_turnover and not scene.remodeling.turnover.is_on:
        raise SceneError(f"{key}: has {' and '.join(of_turnover)}, which only remodeling.turnover knows; it is not set")
    if wanted and GROWTH in changed:
        _check_growth(measured[GROWTH], key, scene.remodeling.turnover)
    return {name: values for name, values in measured.items() if wanted or name not in held}


def _check_growth(growth: Array, key: str, turnover: Turnover) -> None:
    """Whether tissue that has grown in an earlier run can go on as the scene says."""
    if turnover.start:
        raise SceneError(f"{key}: has {GROWTH} of an earlier run; remodeling.turnover.from must be 0 with it")
    if growth.min() <= 1.0 - turnover.volume:
        volume = f"remodeling.turnover.volume must be above {1.0 - growth.min():.3g} with it"
        raise SceneError(f"{key}: has {GROWTH} of an earlier run, {growth.min():.3g} at the least; {volume}")


def read_fibres(cells: Cells, region: str) -> FibreFile:
    from remodel_fenicsx.body.fibres import read_fibre_file  # few scenes have one

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
    way = "by number" if farthest is None else f"the nearest ones, {farthest:.3g} away at most"
    log.info("%s: %s of %d rows, %s; SHA-256 %s", key, names, count, way, file.sha256)
    return {name: values[rows] for name, values in file.measured.items()}


def in_files(fibres: Fibres, name: str, quadrature: Quadrature, domain: Domain) -> Array:
    """An array of files of fibres at the points, (elements, points, ...); `UNCHANGED` where they have none."""
    plain = np.asarray(UNCHANGED[name])
    found = np.tile(plain, (*quadrature.shape, *(1 for _ in plain.shape)))
    for region, measured in fibres.items():
        if name in measured:
            chosen = domain.element_region == domain.regions[region] if region else np.ones(len(found), dtype=np.bool_)
            found[chosen] = measured[name][domain.element_number[chosen]].reshape(-1, 1, *plain.shape)
    return found
