"""Quasi-Newton steps on a kept factor: L-BFGS with PETSc's vectors, on any number of ranks."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

REMEMBERED_PAIRS = 20  # pairs that are remembered
CURVED = 1e-8  # cosine between a step and the change of the residual, below which they say nothing of use


@dataclass(frozen=True)
class _Pair:
    """A step s, the change z of the residual over it, and H z with the kept inverse H."""

    step: Any
    change: Any
    image: Any
    curvature: float

    def destroy(self) -> None:
        for vector in (self.step, self.change, self.image):
            vector.destroy()


class Secants:
    """Betters the steps of a kept factor by what earlier steps have shown of the present tangent.

    The two loops of L-BFGS around H r, the step that the kept factor gives. It needs H times the remembered changes of
    the residual as well; these are differences of steps that have been there already, so nothing is solved for them.
    Pairs stay valid from solve to solve, until the factor is another one.
    """

    def __init__(self) -> None:
        self._pairs: deque[_Pair] = deque()
        self._last: tuple[Any, Any, Any] | None = None

    def forget(self) -> None:
        """The factor is another one."""
        self.interrupt()
        for pair in self._pairs:
            pair.destroy()
        self._pairs.clear()

    def interrupt(self) -> None:
        """The next step does not follow the last one: another problem, or another place."""
        if self._last is not None:
            for vector in self._last:
                vector.destroy()
        self._last = None

    def improve(self, x: Any, residual: Any, step: Any) -> bool:
        """Better the step H r (trial: x - step) in place; whether it was changed.

        Parameters
        ----------
        x, residual
            The unknowns, and the residual there.
        step
            H r.
        """
        self._learn(x, residual, step)
        self._last = (x.copy(), residual.copy(), step.copy())
        if not self._pairs:
            return False
        right, weights = residual.copy(), []
        for pair in reversed(self._pairs):
            weight = pair.step.dot(right) / pair.curvature
            weights.append(weight)
            right.axpy(-weight, pair.change)
            step.axpy(-weight, pair.image)
        for pair, weight in zip(self._pairs, reversed(weights), strict=True):
            step.axpy(weight - pair.change.dot(step) / pair.curvature, pair.step)
        right.destroy()
        return True

    def _learn(self, x: Any, residual: Any, step: Any) -> None:
        if self._last is None:
            return
        before = self._last
        self._last = None
        way, change, image = pair = [now.copy() for now in (x, residual, step)]
        for now, then in zip(pair, before, strict=True):
            now.axpy(-1.0, then)
            then.destroy()
        curvature = way.dot(change)
        if curvature > CURVED * way.norm() * change.norm():
            self._pairs.append(_Pair(way, change, image, curvature))
            if len(self._pairs) > REMEMBERED_PAIRS:
                self._pairs.popleft().destroy()
        else:
            for vector in pair:
                vector.destroy()
