"""The page in a real browser: it gets ready, says nothing, asks for nothing, and does what its controls say.

Without a browser these tests are skipped: WITH_FENICSX_ADD=browser ./with-fenicsx tests/run tests/report has one.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from remodel_fenicsx.report import REPORT, write_report
from remodel_fenicsx.results.recording import ANGLE_COLOURS
from remodel_fenicsx import Recording
from tests.browser import Browser, Pixels, browser_path
from tests.report.conftest import RUNS, Recorded
from tests.report.test_report import HOSTILE, Decoded

if browser_path() is None and not os.environ.get("REQUIRE_BROWSER"):
    pytest.skip("no browser (chromium-headless-shell) is here; WITH_FENICSX_ADD=browser brings one",
                allow_module_level=True)  # fmt: skip
WITH_A_BODY = [name for name in RUNS if name != "without fields"]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """One for all tests."""
    with Browser() as found:
        yield found


def drawn(pixels: Pixels) -> Pixels:
    """(n, 3) of what is not ground."""
    found: Pixels = pixels.reshape(-1, 3)[(pixels.reshape(-1, 3) < 250).any(axis=1)]
    return found


def body(browser: Browser) -> Pixels:
    """Pixels of the body, without the words over it."""
    browser.value("document.querySelectorAll('.over').forEach(e => e.style.visibility = 'hidden')")
    return browser.screenshot("#body")


def quiet(browser: Browser, page: Path) -> bool:
    """Whether the page has said nothing and asked for nothing but itself."""
    assert browser.said == [] and browser.requests == [page.as_uri()]
    return True


# ---------------------------------------------------------------- every kind of run
@pytest.mark.parametrize("name", WITH_A_BODY)
def test_the_body_is_there(browser: Browser, recorded: Recorded, name: str) -> None:
    page = recorded(name) / REPORT
    browser.open(page)
    pixels = body(browser)
    share = len(drawn(pixels)) / pixels[..., 0].size
    assert 0.05 < share < 0.9 and len(np.unique(drawn(pixels), axis=0)) > 4
    assert quiet(browser, page)
    assert browser.value("document.documentElement.scrollWidth") <= 1360


def test_a_run_without_fields_has_its_curves(browser: Browser, recorded: Recorded) -> None:
    page = recorded("without fields") / REPORT
    browser.open(page)
    assert browser.value("document.querySelector('#body')") is None
    assert browser.value("document.querySelectorAll('.curve canvas').length") >= 5
    before = browser.screenshot("#curve-0")
    browser.press("ArrowLeft")
    assert (
        browser.value("REPORT.clock.time") == 2.0
        and (browser.screenshot("#curve-0") != before).any()
    )
    assert quiet(browser, page)


# ---------------------------------------------------------------- what the page says of the data
@pytest.mark.parametrize("name", ["artery", "tendon"])
def test_profile_and_rose_are_volume_means(browser: Browser, recorded: Recorded, name: str) -> None:
    run, found = Recording(recorded(name)), Decoded.from_run(recorded(name))
    browser.open(recorded(name) / REPORT)
    layer, volume = found.arrays["view.layer"], found.arrays["view.volume"]
    for index in (0, len(run.times) // 2, len(run.times) - 1):
        angle = run.fields(run.times[index])["fibre_angle_deformed"]
        expected = np.bincount(layer, weights=volume * angle) / np.bincount(layer, weights=volume)
        shown = [one["mean"] for one in browser.value(f"REPORT.clock.profileAt({index})")]
        np.testing.assert_allclose(shown, expected, atol=0.2)
        rose = browser.value(f"Array.from(REPORT.clock.roseAt({index}))")
        assert sum(rose) == pytest.approx(1.0, abs=1e-9)
        counted = np.histogram(
            angle, bins=np.linspace(0, 90, len(ANGLE_COLOURS) + 1), weights=volume
        )[0]
        np.testing.assert_allclose(rose, counted, atol=1e-5)


# ---------------------------------------------------------------- controls
def test_the_slider_leads_through_time_and_back(browser: Browser, recorded: Recorded) -> None:
    browser.open(recorded("artery") / REPORT)
    assert browser.value("document.querySelector('#clock').textContent") == "t = 10"
    end = browser.screenshot("#body")
    browser.click("#time", across=0.001)
    assert browser.value("document.querySelector('#clock').textContent") == "t = 0"
    assert (
        browser.value("document.querySelector('#time').getAttribute('aria-valuetext')") == "t = 0"
    )
    assert (browser.screenshot("#body") != end).mean() > 0.02
    browser.click("#time", across=0.999)
    np.testing.assert_array_equal(browser.screenshot("#body"), end)
    profile = browser.value("document.querySelector('#profile').innerHTML")
    browser.press("Home")  # the slider has the focus
    assert browser.value("REPORT.clock.time") == 0.0
    assert browser.value("document.querySelector('#profile').innerHTML") != profile


def test_a_click_on_a_curve_goes_to_its_time(browser: Browser, recorded: Recorded) -> None:
    browser.open(recorded("artery") / REPORT)
    browser.click("#curve-0 .u-over", across=0.4)
    assert browser.value("REPORT.clock.time") == 4.0
    words = browser.value("document.querySelector('#curve-0 .values').textContent")
    radius = Recording(recorded("artery")).value("inner_radius", 4.0)
    assert "t = 4" in words and f"{radius:.4g}" in words


def test_peeled_to_its_last_layer_an_artery_is_another_colour(
    browser: Browser, recorded: Recorded
) -> None:
    """Its inner layer has turned towards the circumference, red, its outer one has not."""
    browser.open(recorded("artery") / REPORT)
    browser.choose("#shown", "angle")

    def mean_angle() -> float:
        pixels = drawn(body(browser)).astype(float)
        scale = np.array(
            [[int(one[k : k + 2], 16) for k in (1, 3, 5)] for one in ANGLE_COLOURS], dtype=float
        )
        level = np.linalg.norm(pixels[:, None] - scale, axis=2).argmin(axis=1)
        return float(level.mean() * 5)

    outside = mean_angle()
    browser.value("document.querySelectorAll('.over').forEach(e => e.style.visibility = '')")
    browser.click("#peel", across=0.999)
    assert browser.value("document.querySelector('#peeled').textContent") == "7 of 8 layers"
    assert mean_angle() < outside - 5


@pytest.mark.parametrize("control", ["#cut half", "#cut quarter", "#shown coloured", "#shown alone", "#shown angle",
                                     "#shown extension", "#shown shape"])  # fmt: skip
def test_a_choice_changes_the_picture_and_back(
    browser: Browser, recorded: Recorded, control: str
) -> None:
    browser.open(recorded("artery") / REPORT)
    before = body(browser)
    selector, value = control.split()
    browser.choose(selector, value)
    changed = body(browser)
    assert (changed != before).any(axis=2).mean() > 0.005 and len(drawn(changed)) > 5000
    browser.choose(selector, "whole" if selector == "#cut" else "both")
    np.testing.assert_array_equal(body(browser), before)


def test_downloads_are_the_files_of_the_run(
    browser: Browser, recorded: Recorded, tmp_path: Path
) -> None:
    folder = recorded("cube")
    browser.open(folder / REPORT)
    browser.call("Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    for name in ("scene.toml", "history.csv"):
        browser.click(f'.download[data-file="{name}"]')
        browser.wait_until(lambda name=name: (tmp_path / name).exists())
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()
    browser.click("#picture")
    browser.wait_until(lambda: (tmp_path / "cube-t10.png").exists())
    assert (tmp_path / "cube-t10.png").read_bytes().startswith(b"\x89PNG")


def test_a_browser_that_draws_nothing_in_space_shows_the_rest(recorded: Recorded) -> None:
    with Browser("--disable-3d-apis") as browser:
        browser.open(recorded("artery") / REPORT)
        assert "no WebGL" in browser.value("document.querySelector('.stage').textContent")
        browser.press("Home")
        assert browser.value("document.querySelector('#clock').textContent") == "t = 0"
        assert browser.said == []


def test_every_control_has_a_name(browser: Browser, recorded: Recorded) -> None:
    """Of those that a screen reader says."""
    browser.open(recorded("artery") / REPORT)
    nodes = browser.call("Accessibility.getFullAXTree")["nodes"]
    roles = ("button", "slider", "combobox", "link", "image", "img")
    found = [
        (node["role"]["value"], node.get("name", {}).get("value"))
        for node in nodes
        if not node["ignored"]
    ]
    controls = [one for one in found if one[0] in roles]
    assert len(controls) > 15 and all(name for _, name in controls)


def test_text_of_others_runs_nothing(browser: Browser, recorded: Recorded, tmp_path: Path) -> None:
    folder = recorded("cube")
    for name in ("scene.toml", "history.csv", "run.log"):
        shutil.copy(folder / name, tmp_path / name)
    with (tmp_path / "run.log").open("a") as log:
        log.write(f"2026-01-02 03:04:05,000 WARNING {HOSTILE}\n")
    with (tmp_path / "scene.toml").open("a") as scene:
        scene.write(f"# {HOSTILE}\n")
    page = write_report(tmp_path)
    browser.open(page)
    assert HOSTILE in browser.value("document.body.textContent")
    assert browser.value("document.querySelectorAll('main img').length") == 0
    assert quiet(browser, page)
