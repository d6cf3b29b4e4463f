"""Families of the consistent variant: law `tensor`, repulsion `log`, staggered and extrapolated, typed by hand here."""

from __future__ import annotations

from functools import partial

import numpy as np

from benchmarks.stability_map.bodies import check_long, ring, tendon_case, tube_case, twisted_case
from benchmarks.stability_map.cases import Case, Finding, Run, table
from benchmarks.stability_map.homogeneous import (
    DRIVERS,
    ELEMENTS,
    RAMP,
    TRIAXIAL,
    case_of_shape,
    compared,
    cube_case,
    element,
    triaxial,
)
from benchmarks.stability_map.march import initial, material, nominal_stress, step_times
from benchmarks.stability_map.point import Array, NoEquilibrium, Path, advance
from benchmarks.stability_map.prescribed import FINER, REFERENCE, REVERSED, compared_with_limit, gradients
from tests.reference.radial import RadialMaterial, cauchy_stress, driving_values, secant_stiffness

SCHEMES = ("staggered", "extrapolated")
VARIANT = {"remodeling.law": "tensor", "remodeling.frame": "material", "material.repulsion": "log"}
COMPRESSION = 0.1


# ---------------------------------------------------------------- the law, along fixed axes
class Target:
    """E (3) and s of a state with axes along x, y, z."""

    def __init__(self, direction: Array, share: float, time: float):
        self.direction, self.share, self.time = direction, share, time

    @classmethod
    def of(cls, driver: str, stretches: Array, squares: Array, m: RadialMaterial, time: float) -> Target:
        """For `finger` C, for the others sigma or S, as their positive parts."""
        values = driving_values(driver, stretches[None], cauchy_stress(stretches[None], squares[None], m))[0]
        positive, negative = np.maximum(values, 0.0) ** 2, np.minimum(values, 0.0) ** 2
        tension = positive.sum()
        # what is below rounding of the stress remodels nothing
        network = m.network_modulus * secant_stiffness(np.array(r0 := m.end_to_end_length), m.contour_length) * r0**2
        floor = 0.0 if driver == "finger" else (1e-7 * (m.lame_lambda + 2 * m.lame_mu + float(network))) ** 2
        share = tension / (tension + COMPRESSION**2 * negative.sum() + floor)
        return cls(positive / (tension or 1.0), float(share), time)

    def ahead(self, before: Target | None, time: float) -> Target:
        """In the middle of the step to `time`, along the line through two states."""
        if before is None:
            return self
        slope = (time - self.time) / 2 / (self.time - before.time)
        direction = self.direction + slope * (self.direction - before.direction)
        return Target(direction, float(np.clip(self.share + slope * (self.share - before.share), 0, 1)), time)

    def follow(self, squares: Array, r0: float, rate: float) -> Array:
        """dA/dt = kappa s (r0^2 E - A), exactly."""
        return squares + (r0**2 * self.direction - squares) * -np.expm1(-rate * self.share)


def diagonal_path(
    m: RadialMaterial, forces: Array, times: Array, dimensions: Array, driver: str, scheme: str, kappa: float
) -> Path:
    """As `march.march` of a bar, for the law `tensor`, typed once more. Coaxial, the repulsion `log` is the paper's."""
    squares, stretches, load, path = dimensions**2, np.ones(3), np.zeros(3), Path()
    old, last, before, r0, start = squares, None, None, m.end_to_end_length, 0.0
    for time, new_load in zip(times, forces, strict=True):
        now, rate = float(time), kappa * (float(time) - start)
        try:
            if scheme == "extrapolated" and last is not None:
                squares = last.ahead(before, now).follow(old, r0, rate)
            stretches = advance(stretches, (old[None], load), (squares[None], new_load), m)
            if scheme == "extrapolated" and last is None:
                old, load = squares, new_load
                squares = Target.of(driver, stretches, squares, m, now).follow(squares, r0, rate)
                stretches = advance(stretches, (old[None], load), (squares[None], new_load), m)
        except NoEquilibrium as error:
            path.ended = f"no equilibrium at t = {now:g}: {error}"
            return path
        path.times.append(now)
        path.stretches.append(stretches)
        path.squares.append(squares)
        old, load = squares, new_load
        if scheme == "extrapolated":
            before, last = last, Target.of(driver, stretches, squares, m, now)
        else:
            squares = Target.of(driver, stretches, squares, m, now).follow(squares, r0, rate)
        start = now
    return path


def check_point(case: Case, run: Run) -> Finding:
    """Stretch and angle by step, and the cells at the end; `saddle` is that of another repulsion."""
    scene, times = case.scene, step_times(case.scene)
    r = scene["remodeling"]
    path = diagonal_path(
        material(scene), nominal_stress(scene, times), times, initial(scene), r["driver"], r["coupling"], r["kappa"]
    )
    return compared(scene, run, path)


# ---------------------------------------------------------------- any deformation, prescribed
def cauchy(F: Array, A: Array, m: RadialMaterial) -> Array:
    """sigma of W_iso + W_chn(r), r^2 = A : C, - c/2 g(r0) A : ln C."""
    C, J = F.T @ F, np.linalg.det(F)
    squares, Q = np.linalg.eigh(C)
    near = np.abs(squares[:, None] - squares) < 1e-7 * squares.max()
    middle = (squares[:, None] + squares) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        quotients = (np.log(squares)[:, None] - np.log(squares)) / (squares[:, None] - squares)
    dlnC = Q @ (np.where(near, 1 / middle, quotients) * (Q.T @ A @ Q)) @ Q.T
    g, g0 = (secant_stiffness(r, m.contour_length) for r in (np.sqrt(np.sum(A * C)), np.array(m.end_to_end_length)))
    inner = m.lame_mu * np.eye(3) + m.network_modulus * (g * A - g0 * dlnC)
    return np.asarray(((m.lame_lambda * np.log(J) - m.lame_mu) * np.eye(3) + F @ inner @ F.T) / J)


def material_driver(driver: str, F: Array, sigma: Array) -> Array:
    """R^T sigma R, S or C."""
    C = F.T @ F
    if driver == "finger":
        return C
    if driver == "pk2":
        inverse = np.linalg.inv(F)
        return inverse @ sigma @ inverse.T
    squares, Q = np.linalg.eigh(C)
    R = F @ (Q / np.sqrt(squares)) @ Q.T
    return R.T @ sigma @ R


def prescribed_end(m: RadialMaterial, F: Array, times: Array, start: Array, driver: str, kappa: float) -> Array:
    """A at the last time but one step, for small steps: remodeled after each state."""
    A, before, r0 = np.diag(start**2), 0.0, m.end_to_end_length
    for time, gradient in zip(times[:-1], F[:-1], strict=True):
        values, vectors = np.linalg.eigh(material_driver(driver, gradient, cauchy(gradient, A, m)))
        positive, negative = np.maximum(values, 0.0) ** 2, np.minimum(values, 0.0) ** 2
        if positive.sum() > 0:
            share = positive.sum() / (positive.sum() + COMPRESSION**2 * negative.sum())
            direction = (vectors * positive / positive.sum()) @ vectors.T
            A = A + (r0**2 * direction - A) * -np.expm1(-kappa * (float(time) - before) * share)
        before = float(time)
    return A


def check_limit(case: Case, run: Run) -> Finding:
    """F everywhere as on the boundary, and A as for dt -> 0; the staggered row is a pass behind."""
    scene, r = case.scene, case.scene["remodeling"]
    behind = scene["time"]["step"] if r["coupling"] == "staggered" else 0.0
    end = step_times(scene)[-1] - behind

    def limit(finer: int) -> Array:
        step = scene["time"]["step"] / finer
        times = step * np.arange(1, round(end / step) + 2)
        return prescribed_end(
            material(scene), gradients(scene, times), times, initial(scene), r["driver"], r["kappa"]
        )  # fmt: skip

    return compared_with_limit(scene, run, limit(FINER), limit(FINER // 2))


# ---------------------------------------------------------------- families
variant_case = partial(cube_case, check=check_point)
table(
    "consistent", variant_case,
    {"driver": DRIVERS, "coupling": SCHEMES, "force": (0.01, 0.1, 1.0, 10.0, 100.0, 1e4, -3.0)},
    {**VARIANT, "time.end": 40.0}, reduced=lambda p: p["driver"] == "cauchy" and p["force"] == 10,
)  # fmt: skip
table(
    "consistent", variant_case, {"driver": DRIVERS, "coupling": SCHEMES, "kappa dt": (1e-3, 0.25, 1.0, 10.0, 1e3)},
    {**VARIANT, "time.end": 20.0},
)  # fmt: skip
table(
    "consistent", variant_case, {"driver": DRIVERS, "element": ELEMENTS},
    lambda p: {
        **VARIANT, **element(p), "remodeling.coupling": "extrapolated", "time.end": 20.0, "time.step": 2.0,
    },
)  # fmt: skip

# repeated and crossing principal stresses, loads that turn
table(
    "consistent, three axes", partial(case_of_shape, "block", check_point),
    {"load": TRIAXIAL, "driver": DRIVERS, "coupling": SCHEMES}, lambda p: {**VARIANT, **triaxial(p)},
    only=lambda p: p["driver"] == "cauchy" or p["coupling"] == "extrapolated",
)  # fmt: skip

# axes that are not coaxial, and a shear that changes its sign
table(
    "consistent, shear", partial(case_of_shape, "driven", check_limit, reference=REFERENCE),
    {"shear": (0.3, 1.0), "history": ("held", "reversed"), "driver": DRIVERS, "coupling": SCHEMES},
    lambda p: {
        **VARIANT, "loads.h_xz": {"value": p["shear"], "ramp": RAMP if p["history"] == "held" else REVERSED},
        "time.end": 40.0 if p["history"] == "held" else 80.0,
    },
    only=lambda p: p["history"] == "held" or p["shear"] == 0.3,
    reduced=lambda p: (p["driver"], p["shear"], p["history"]) == ("cauchy", 0.3, "held"),
)  # fmt: skip

# random cells from weak loads to locking, and a twisted bar
table(
    "consistent, bodies", tendon_case,
    {"cells": ("random",), "driver": DRIVERS, "coupling": SCHEMES, "force": (30.0, 300.0, 1000.0)}, VARIANT,
)  # fmt: skip
table(
    "consistent, bodies", twisted_case, {"driver": DRIVERS, "coupling": SCHEMES, "twist": (0.5, 3.0)}, VARIANT
)  # fmt: skip

# Figs. 7, 10 and 11 to their end; a row of the reference is a pass behind that of the schemes but `staggered`
table(
    "consistent, tube", tube_case, {"driver": DRIVERS, "coupling": (*SCHEMES, "implicit")},
    {**VARIANT, "time.end": 150.0, "time.step": 1.0, "mesh.degree": 1},
    more={"counts": ring(16, 8), "check": check_long},
)  # fmt: skip
