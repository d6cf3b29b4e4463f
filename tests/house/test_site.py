"""The site of the documentation: built without a warning, and its own search finds what people look for."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import pytest

from tests.browser import Browser, browser_path
from tests.processes import ran

ROOT = Path(__file__).parents[2]
pytest.importorskip("sphinx", reason="no Sphinx: pip install '.[docs]'")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its folder."""
    folder = tmp_path_factory.mktemp("site")
    done = ran([sys.executable, ROOT / "docs" / "build", "-o", folder])
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


BEST = {  # where a reader wants to be
    "residual stress": "turnover",
    "mmHg": "tutorial_tube",
    "resume": "howto_ranks",
    "STL": "my_own_vessel",
    "systole": "load_cases",
}


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """One for all words."""
    if browser_path() is None and not os.environ.get("REQUIRE_BROWSER"):
        pytest.skip(
            "no browser (chromium-headless-shell) is here; WITH_FENICSX_ADD=browser brings one"
        )
    with Browser() as started:
        yield started


@pytest.mark.parametrize("words, page", BEST.items())
def test_the_first_that_the_search_shows_is_the_right_page(
    site: Path, browser: Browser, words: str, page: str
) -> None:
    """By the site's own script, in a browser, from the disk."""
    browser.open(site / "index.html", wait=False)
    browser.call("Page.navigate", url=f"{(site / 'search.html').as_uri()}?q={quote(words)}")
    first = "document.querySelector('#search-results li a')"
    browser.wait_for(f"{first} !== null")
    assert browser.value(f"{first}.getAttribute('href')").startswith(f"{page}.html")


def test_the_site_needs_no_network(site: Path) -> None:
    """Scripts, styles and pictures of each page are files of the site."""
    asks = re.compile(r'<(?:script|img|link rel="stylesheet")[^>]*? (?:src|href)="([^"#]+)"')
    for page in site.glob("*.html"):
        links = asks.findall(page.read_text(encoding="utf-8"))
        assert len(links) > 5, page.name
        for link in links:
            assert (site / link.partition("?")[0]).exists(), (page.name, link)


def test_each_tutorial_is_a_notebook_too(site: Path) -> None:
    assert len([*site.glob("_downloads/*/tutorial_*.ipynb")]) == 7


def test_every_public_name_has_its_place(site: Path) -> None:
    """Registries too, and what a class inherits from a private base; nothing that is private."""
    import remodel_fenicsx
    from remodel_fenicsx import extend, parts

    text = "".join(
        (site / f"{name}.html").read_text(encoding="utf-8")
        for name in ("api", "api_parts", "api_extend")
    )
    found = re.findall(r'id="remodel_fenicsx\.(?:parts\.|extend\.)?([\w.]+)"', text)
    public = {
        name
        for module in (remodel_fenicsx, parts, extend)
        for name in module.__all__
        if name[0] != "_"
    }
    wanted = public | {"Recording.history", "UnitCells.structure_tensor"}
    assert wanted <= set(found), wanted - set(found)
    assert len(found) == len(set(found)) and not [name for name in found if "model_config" in name]
