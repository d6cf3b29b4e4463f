"""Means over load cases: what cells follow that are in several states by turns. Pure functions on arrays.

With weights w_i, the shares of time, and the states' F_i = R_i U_i: D = sum_i w_i R_i^T sigma_i R_i, which takes each
driving tensor to material space. Remodeling takes days and a cycle a second, so that cells see the mean of many cycles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model.laws import Drive
from remodel_fenicsx.model.tensor_law import Target

Array = NDArray[np.float64]
Drives = Sequence[Drive]
Weights = Sequence[float]


def material_tensor(drive: Drive) -> Array:
    """The driving tensor in material space, (n, 3, 3)."""
    if drive.driver.material:
        return drive.tensor
    return drive.frame.tensor(drive.deformation_gradient, drive.tensor)


def mean_tensor(drives: Drives, weights: Weights) -> Drive:
    """The first state's drive with the weighted mean of all driving tensors, and of what may be an error in them."""
    tensor = _weighted([material_tensor(drive) for drive in drives], weights)
    return _with(
        drives[0],
        tensor,
        _weighted([drive.threshold for drive in drives], weights),
        _weighted([drive.rounding for drive in drives], weights),
    )


def largest_tension(drives: Drives, weights: Weights) -> Drive:
    """At each point the driving tensor of the state whose largest principal value is the largest one."""
    tensors = np.array([material_tensor(drive) for drive in drives])
    chosen = np.linalg.eigvalsh(tensors)[..., -1].argmax(axis=0)
    shape, points = tensors.shape[:2], np.arange(tensors.shape[1])
    threshold, rounding = (
        np.array([np.broadcast_to(getattr(drive, name), shape[1]) for drive in drives])[chosen, points]
        for name in ("threshold", "rounding")
    )
    return _with(drives[0], tensors[chosen, points], threshold, rounding)


def mean_target(targets: Sequence[Target], weights: Weights) -> Target:
    """The weighted mean of sE: what acts on A is linear in it (`Target.towards`)."""
    pulled = _weighted([target.share[:, None, None] * target.direction for target in targets], weights)
    share = np.einsum("nii->n", pulled)
    return Target(pulled / np.where(share > 0.0, share, 1.0)[:, None, None], share)


def _with(drive: Drive, tensor: Array, threshold: Any, rounding: Any) -> Drive:
    driver = replace(drive.driver, material=True)  # the tensor is in material space already
    return drive._replace(tensor=tensor, driver=driver, threshold=threshold, rounding=rounding)


def _weighted(values: Sequence[Any], weights: Weights) -> Any:
    return sum(weight * value for weight, value in zip(weights, values, strict=True))


@dataclass(frozen=True)
class Mean:
    """What becomes of several drives.

    Attributes
    ----------
    meaning
        For docs/scene.md.
    drive
        One drive of all, from (drives, weights).
    of_targets
        Whether a law's targets are averaged in place of the drives.
    """

    meaning: str
    drive: Callable[[Drives, Weights], Drive] = mean_tensor
    of_targets: bool = False


MEANS_OF_CASES: dict[str, Mean] = {
    "tensor": Mean("the weighted mean of the driving tensors"),
    "target": Mean("the weighted mean of the targets that each case has, for the law 'tensor'", of_targets=True),
    "largest": Mean("at each point the load case with the largest tension, whatever its weight", largest_tension),
}
"""By the name that `remodeling.mean` has."""
