"""Principal values and axes of arrays of symmetric tensors, robust at repeated and zero values.

LAPACK's eigenvectors are arbitrary in sign and inside the eigenspace of a repeated value, so that
they differ between machines and between numbers of ranks. The axes enter the stress (erratum 6 of
docs/model.md). Therefore the previous axes decide whatever the tensor leaves undetermined.
"""

from itertools import permutations

import numpy as np
import numpy.typing as npt

from remodel_fenicsx.model.chains import Formula
from remodel_fenicsx.model.tensors import Array, Flags


ROUNDING = 64 * float(np.finfo(np.float64).eps)
"""Relative size below which a principal value is rounding error (eigh is accurate to a few eps)."""

MIN_OVERLAP = 1e-3
"""Cosine below which a previous axis does not determine a direction. In symmetric problems this
cosine is exactly zero up to rounding; any threshold far above rounding gives the same choice on
every machine."""


AGREEMENT = 1e-8
"""Relative difference up to which two principal values count as equal, about the square root of
eps. Their axes have rounding errors of eps / AGREEMENT."""


def principal(
    tensors: npt.ArrayLike,
    previous: npt.ArrayLike,
    tolerance: float = AGREEMENT,
    threshold: npt.ArrayLike = 0.0,
) -> tuple[Array, Array]:
    """Return the principal values, descending, and the principal axes of symmetric tensors.

    If neighbouring values agree (also first with second and second with third), the tensor does not
    determine the axes of these ranks. They are then the previous axes of the same ranks, projected
    onto the common eigenspace and orthonormalised in the order of rank. A previous axis that is
    orthogonal to the eigenspace within ``MIN_OVERLAP`` is replaced by the next previous axis
    (cyclic order of ranks), so that the result never depends on LAPACK. The zero tensor keeps all
    three previous axes.

    Each axis has a positive cosine with the previous axis of its rank. If that cosine is not
    decisive (the axes have swapped ranks), the first decisive cosine with the next two previous
    axes is positive. The triad may be left-handed.

    Parameters
    ----------
    tensors : (n, 3, 3)
        Symmetric tensors, any unit. Only the symmetric part is used.
    previous : (n, 3, 3)
        Rows are the previous axes in the same (spatial or material) frame as the tensors. They need
        not be normalised or orthogonal; F n_I is allowed.
    tolerance : float
        Values whose difference is at most `tolerance` times the largest absolute value count as
        equal.
    threshold : float or (n,)
        Differences up to this size, in the unit of the tensors, count as zero too. With the default
        0 the axes do not depend on the unit.

    Returns
    -------
    values : (n, 3)
        Principal values, descending.
    axes : (n, 3, 3)
        Orthonormal rows; row I belongs to value I.

    Raises
    ------
    FloatingPointError
        If a tensor or a previous axis contains NaN or infinity; the message names the first.

    Examples
    --------
    >>> import numpy as np
    >>> from remodel_fenicsx.extend import principal
    >>> values, axes = principal(np.diag([1.0, 3.0, 2.0])[None], np.eye(3)[None])
    >>> values
    array([[3., 2., 1.]])
    >>> axes[0]
    array([[0., 1., 0.],
           [0., 0., 1.],
           [1., 0., 0.]])
    """
    values, axes, reference = _decomposed(tensors, previous)
    return values, _settled(axes, reference, *_agreeing(values, tolerance, threshold))


def principal_by_continuity(
    tensors: npt.ArrayLike,
    previous: npt.ArrayLike,
    tolerance: float = AGREEMENT,
    threshold: npt.ArrayLike = 0.0,
) -> tuple[Array, Array]:
    """Return principal values and axes of symmetric tensors in the order of previous axes."""
    # Each principal axis takes the position of the previous axis that it continues. Of the six
    # pairings the one with the largest sum of squared cosines is taken, so that values that cross
    # do not exchange their positions. If values agree, their common eigenspace counts as a whole,
    # and the paired previous axes are kept in it as by `principal`. If the sums of several pairings
    # agree within ``MIN_OVERLAP``, the first in lexicographic order is taken, so that rounding does
    # not decide. Parameters and errors are those of `principal`.
    values, axes, reference = _decomposed(tensors, previous)
    upper, lower = _agreeing(values, tolerance, threshold)
    positions = _places(axes, reference, upper, lower)
    axes = _settled(
        axes, np.take_along_axis(reference, positions[:, :, None], axis=1), upper, lower
    )
    order = np.argsort(positions, axis=1)
    return np.take_along_axis(values, order, axis=1), np.take_along_axis(
        axes, order[:, :, None], axis=1
    )


Pairing = Formula[tuple[Array, Array]]

PAIRINGS: dict[str, Pairing] = {"sorted": principal, "continuous": principal_by_continuity}
"""Pairings of cell dimensions with principal values: by rank, or by continued axis."""


def positive_direction(
    values: npt.ArrayLike, threshold: npt.ArrayLike = 0.0
) -> tuple[Array, Flags]:
    """Return e = lambda^+ / |lambda^+| (eqs. 9 to 11), and the points with a positive value."""
    values = np.asarray(values, dtype=np.float64)
    _require_finite(values, "set of principal values")
    largest = _largest(values)
    rounding = np.maximum(ROUNDING * largest, threshold)
    # Scaled by the largest value, because squares of very small or large values would underflow or
    # overflow.
    positive = (
        np.where(values > rounding[:, None], values, 0.0)
        / np.where(largest > 0.0, largest, 1.0)[:, None]
    )
    norm = _length(positive)
    active = norm > 0.0
    return positive / np.where(active, norm, 1.0)[:, None], active


def drop_noise_shear(tensors: Array, axes: Array, noise: npt.ArrayLike) -> Array:
    """Return the tensors without shear components in these axes if none exceeds `noise`."""
    # If two principal values are close, an error of the tensor rotates its axes by far more than
    # the relative error. The shear components in the old axes are therefore set to zero up to
    # `noise`.
    first = _normalised(axes[:, 0])
    second = _normalised(axes[:, 1] - np.einsum("na,na->n", axes[:, 1], first)[:, None] * first)
    frame = np.stack([first, second, np.cross(first, second)], axis=1)
    components = frame @ tensors @ np.swapaxes(frame, 1, 2)
    across = _largest(
        np.stack([components[:, 0, 1], components[:, 1, 2], components[:, 0, 2]], axis=1)
    )
    values = np.einsum("nii->ni", components)
    steady = np.swapaxes(frame, 1, 2) @ (values[:, :, None] * frame)
    return np.where((across <= np.asarray(noise, dtype=np.float64))[:, None, None], steady, tensors)


def _decomposed(tensors: npt.ArrayLike, previous: npt.ArrayLike) -> tuple[Array, Array, Array]:
    """Return descending values, LAPACK's axes as rows, and the normalised previous axes."""
    tensors = np.asarray(tensors, dtype=np.float64)
    previous = np.asarray(previous, dtype=np.float64)
    _require_finite(tensors, "tensor")
    _require_finite(previous, "triad of previous axes")

    ascending, columns = np.linalg.eigh(0.5 * tensors + 0.5 * np.swapaxes(tensors, 1, 2))
    values = ascending[:, ::-1].copy()
    axes = np.swapaxes(columns, 1, 2)[:, ::-1].copy()
    return values, axes, _normalised(previous)


def _agreeing(values: Array, tolerance: float, threshold: npt.ArrayLike) -> tuple[Flags, Flags]:
    """Return the points whose first two and whose last two values agree."""
    equal = np.maximum(tolerance * _largest(values), threshold)
    return values[:, 0] - values[:, 1] <= equal, values[:, 1] - values[:, 2] <= equal


def _settled(axes: Array, reference: Array, upper: Flags, lower: Flags) -> Array:
    """Return the axes with signs and undetermined directions taken from `reference`."""
    for cluster, normal_rank, first, second in (upper & ~lower, 2, 0, 1), (lower & ~upper, 0, 1, 2):
        points = np.flatnonzero(cluster)
        if points.size:
            normal = axes[points, normal_rank]
            axes[points, first] = _project(normal, _candidates(reference[points], first))
            axes[points, second] = np.cross(normal, axes[points, first])
    points = np.flatnonzero(upper & lower)
    if points.size:
        axes[points, 0] = _project(np.zeros((points.size, 3)), _candidates(reference[points], 0))
        axes[points, 1] = _project(axes[points, 0], _candidates(reference[points], 1))
        axes[points, 2] = np.cross(axes[points, 0], axes[points, 1])
    return align_signs(reference, axes)


def _places(axes: Array, reference: Array, upper: Flags, lower: Flags) -> npt.NDArray[np.intp]:
    """Return for each rank the number of the previous axis that it continues, (n, 3)."""
    overlap = np.einsum("nia,nja->nij", axes, reference) ** 2
    # For an eigenspace only the sum over a basis has a meaning.
    for cluster, ranks in (
        (upper & ~lower, [0, 1]),
        (lower & ~upper, [1, 2]),
        (upper & lower, [0, 1, 2]),
    ):
        points = np.flatnonzero(cluster)
        overlap[points[:, None], ranks] = overlap[points][:, ranks].mean(axis=1, keepdims=True)
    pairings = np.array(list(permutations(range(3))))
    sums = sum(overlap[:, rank, pairings[:, rank]] for rank in range(3))
    return pairings[np.argmax(sums >= sums.max(axis=1, keepdims=True) - MIN_OVERLAP, axis=1)]


def _require_finite(values: Array, noun: str) -> None:
    if not np.isfinite(values).all():
        invalid = ~np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
        first = int(np.argmax(invalid))
        raise FloatingPointError(
            f"{noun} {first} of {len(values)} is not finite ({int(invalid.sum())} in all): "
            f"{values[first].tolist()}"
        )


def _largest(vectors: Array) -> Array:
    """Return the largest absolute component of vectors (..., 3)."""
    # By columns it is ten times faster than np.max.
    size = np.abs(vectors)
    return np.maximum(np.maximum(size[..., 0], size[..., 1]), size[..., 2])


def _length(vectors: Array) -> Array:
    return np.sqrt(np.einsum("...a,...a->...", vectors, vectors))


def _normalised(vectors: Array) -> Array:
    """Return unit vectors (..., 3); zero vectors stay zero."""
    largest = _largest(vectors)
    # Scaled, because squares must not overflow.
    vectors = vectors / np.where(largest > 0.0, largest, 1.0)[..., None]
    length = _length(vectors)
    return vectors / np.where(length > 0.0, length, 1.0)[..., None]


def _candidates(reference: Array, rank: int) -> list[Array]:
    """Return candidate directions (n, 3) for a rank, best first; the coordinate axes come last."""
    coordinate_axes = [np.broadcast_to(row, (len(reference), 3)) for row in np.eye(3)]
    return [reference[:, (rank + shift) % 3] for shift in range(3)] + coordinate_axes


def _project(normal: Array, candidates: list[Array]) -> Array:
    """Project the first candidate that is not along the normal onto the normal plane; normalise."""
    # The normals are unit vectors (n, 3); zero vectors stand for the whole space instead of a
    # plane.
    chosen = np.zeros_like(normal)
    open_points = np.ones(len(normal), dtype=bool)
    for candidate in candidates:
        projected = candidate - np.einsum("na,na->n", candidate, normal)[:, None] * normal
        usable = open_points & (_length(projected) > MIN_OVERLAP)
        chosen[usable] = projected[usable]
        open_points &= ~usable
        if not open_points.any():
            break
    chosen = _normalised(chosen)
    # Repeated, because the projection of a candidate almost along the normal is orthogonal only to
    # 1e-13.
    return _normalised(chosen - np.einsum("na,na->n", chosen, normal)[:, None] * normal)


def align_signs(reference: Array, axes: Array) -> Array:
    """Return axes (n, 3, 3) with the signs of `principal`; rows of `reference` are unit vectors."""
    decisive = np.einsum("nia,nia->ni", axes, reference)
    for shift in (1, 2):
        point, rank = np.nonzero(np.abs(decisive) <= MIN_OVERLAP)
        if point.size:
            next_previous = reference[point, (rank + shift) % 3]
            decisive[point, rank] = np.einsum("na,na->n", axes[point, rank], next_previous)
    return np.where(decisive[:, :, None] < 0.0, -axes, axes)
