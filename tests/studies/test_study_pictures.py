"""The pictures of studies: title, verdict, units; nothing lies on anything else, or beyond the edge."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from remodel_fenicsx.scene.scene import preset_scene
from remodel_fenicsx.studies.study import StudyResult, Page
from remodel_fenicsx.studies.stability import Analysis
from remodel_fenicsx.studies.trade import Trade
from tests.studies.test_ensemble import of_seeds
from tests.studies.test_trade import artery, compared


def the_ensemble(seeds: int) -> StudyResult:
    scene = preset_scene("kuhl-holzapfel-2007", "tube").with_values({"geometry.length_unit": "mm"})
    time, rng = np.arange(151.0), np.random.default_rng(1)
    names = (
        "inner_radius",
        "outer_radius",
        "fibre_angle_inner",
        "fibre_angle_outer",
        "max_chain_extension",
    )
    columns = {name: 1 + rng.normal(0, 0.1, (seeds, 1)) * time for name in names}
    return of_seeds(scene, columns)


def the_analysis(factor: float) -> StudyResult:
    factors = dict(zip(np.linspace(15.0, 150.0, 10), np.linspace(0.0, factor, 10), strict=True))
    return Analysis(preset_scene("kuhl-holzapfel-2007", "tube"), factors, "radial", 0.5)


def the_trade(noise: float) -> StudyResult:
    return Trade(artery(), compared(noise, **{"cells.initial": "random"} if noise else {}))


@pytest.mark.parametrize(("study", "value", "labels"), [
    (the_ensemble, 8, {"inner radius, mm", "fibre angle inner, °", "largest r/L", "time"}),
    (the_ensemble, 3, {"outer radius, mm"}),
    (the_analysis, -0.5, {"factor of one pass on a\nsmall change of the cells"}),
    (the_analysis, -300.0, {"time"}),
    (the_trade, 0.0, {"CPU time, seconds", "error of the fibre angle, degrees"}),
    (the_trade, 0.3, {"CPU time, seconds"}),
])  # fmt: skip
def test_a_picture_says_its_answer_and_every_word_can_be_read(
    study: Callable[[float], StudyResult],
    value: float,
    labels: set[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found: list[tuple[Page, Figure]] = []
    save = Page.save_figure

    def saved(page: Page, figure: Figure, made_with: str) -> None:
        save(page, figure, made_with)
        figure.draw_without_rendering()  # in its own dots an inch
        found.append((page, figure))

    monkeypatch.setattr(Page, "save_figure", saved)
    answer = study(value)
    answer.write(tmp_path)
    ((page, figure),) = found
    words = [text.get_text() for text in figure.texts]
    assert " ".join("".join(words).split("\n")) == f"{page.title} {answer.verdict()}"
    said = {text for axes in figure.axes for text in (axes.get_xlabel(), axes.get_ylabel())}
    assert labels <= said and not any("_" in text for text in said)
    boxes = [text.get_window_extent() for text in figure.texts]
    boxes += [legend.get_window_extent() for legend in figure.legends]
    boxes += [
        box for axes in figure.axes if axes.axison and (box := axes.get_tightbbox()) is not None
    ]
    assert len(figure.legends) >= 1 and all(not axes.get_legend() for axes in figure.axes)
    for number, box in enumerate(boxes):
        assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1, number
        assert figure.bbox.y0 <= box.y0 and box.y1 <= figure.bbox.y1, number
        assert not any(box.padded(-1).overlaps(other) for other in boxes[:number]), number


def test_the_verdict_on_settings_is_that_of_trusted_ones() -> None:
    rows = compared()
    good = [row for row in rows if row.angle_error <= 1.0 and not row.doubt]
    cheapest = min(good, key=lambda row: (row.seconds, row.angle_error))
    said = (
        f"{cheapest.seconds:.2g} s of CPU time for an error of {cheapest.angle_error:.2g} degrees."
    )
    verdict = Trade(artery(), rows).verdict()
    assert verdict.startswith("The cheapest setting within 1 degree is ") and verdict.endswith(said)
    others = [row._replace(doubt="noise") if row is cheapest else row for row in rows]
    assert not Trade(artery(), others).verdict().endswith(said)
    coarse = Trade(artery(), [row for row in rows if row.angle_error > 1.0])
    assert coarse.verdict().startswith("No setting is known to be within 1 degree; the closest is ")
    doubted = Trade(artery(), [row._replace(doubt="noise") for row in rows])
    assert (
        doubted.verdict() == f"Not known: all {len(rows)} errors are doubted; trade.csv says why."
    )
