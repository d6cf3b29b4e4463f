"""The page as one file: template, cards, data, scripts; nothing in it asks for anything from outside."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import os
from html import escape
from pathlib import Path
from typing import Any

from remodel_fenicsx._version import __version__
from remodel_fenicsx.errors import RemodelError
from remodel_fenicsx.report.card import Card, ShownBody, packed
from remodel_fenicsx.report.parts import ASSETS, ReportedRun, Story, cards, data_of
from remodel_fenicsx.results.recording import RecordedRun, kept_times
from remodel_fenicsx.results.whole_body import WholeBody, has_a_body
from remodel_fenicsx.system.files import read_regular, write_new, write_whole

REPORT = "report.html"
PAGE_SIZE = 20.0  # MB that a page has at most, if it need not be larger for two times
SCRIPTS = ("data.js", "body.js", "angles.js", "curves.js", "page.js")
STYLES = ("report.bundle.css", "page.css")
GENERATOR_TAG = b'name="generator" content="remodel_fenicsx'  # what bears it may be made anew
LARGEST_PAGE = 10**9  # bytes
FEWEST_TIMES = 2
BEST_RATIO = 0.15  # of deflated to plain bytes of fields: none was smaller, so that no time is left out too early
TRIES = 4


class ReportError(RemodelError, ValueError):
    """No report for a reason that its one line names."""


def write_report(folder: str | os.PathLike[str], path: Path | None = None, size: float = PAGE_SIZE) -> Path:
    """Make the report of a run, finished or not, from its folder."""
    recording = RecordedRun(folder)
    if path is not None:
        try:
            write_new(path, page_of(recording, size).encode("utf-8"))
        except FileExistsError as error:
            raise ReportError(f"path {path}: is there already; allowed is a new file") from error
        return path
    path = recording.path / REPORT
    if path.exists() and GENERATOR_TAG not in read_regular(path, LARGEST_PAGE)[:4096]:
        raise ReportError(f"{path}: is no report of this command and is not overwritten; choose another file")
    write_whole(path, page_of(recording, size).encode("utf-8"))
    return path


def page_of(recording: RecordedRun, size: float = PAGE_SIZE) -> str:
    """The page as text; parameters and errors as of `write_report`."""
    story = Story.of(recording)
    if not has_a_body(recording):
        return page_with(cards(ReportedRun(recording, story, None)))
    whole, most = WholeBody(recording), _times_at_most(recording, size)
    for _ in range(TRIES):
        body = ShownBody.of(whole, kept_times(story.history, recording.times, most))
        found = cards(ReportedRun(recording, story, body))
        page = page_with(found)
        if len(page) <= 1e6 * size or len(body.times) <= FEWEST_TIMES:
            break
        rest = len(page_with([card for card in found if card.name != "view"]))
        share = max(0.0, 1e6 * size - rest) / (len(page) - rest)
        most = max(FEWEST_TIMES, min(len(body.times) - 1, math.floor(0.97 * share * len(body.times))))
    return page


def _times_at_most(recording: RecordedRun, size: float) -> int:
    """More times than this do not fit, however small they become."""
    count = 6 * len(recording.points) + 11 * len(recording.elements)
    return max(FEWEST_TIMES, int(1e6 * size / (4 / 3 * BEST_RATIO * count)))


def page_with(found: list[Card]) -> str:
    """A page with these cards, the first one the head, whose data have the page's `name`."""
    data, arrays = data_of(found)
    block, table = packed(arrays)
    script = "{\n" + "\n".join(_asset(name) for name in SCRIPTS) + "\n}\n"
    style = "\n".join(_asset(name) for name in STYLES)
    bundle = _asset("report.bundle.js")
    parts = {
        "POLICY": policy([bundle, script], style),
        "GENERATOR": f"remodel_fenicsx {__version__}",
        "TITLE": escape(str(data["head"]["name"])),
        "STYLE": style,
        "CARDS": "\n".join(card.html for card in found),
        "DATA": as_json({"parts": data, "arrays": table}),
        "ARRAYS": block,
        "BUNDLE": bundle,
        "SCRIPT": script,
    }
    pieces = _asset("template.html").split("@")  # what is put in is not looked at again
    return "".join(parts[piece] if index % 2 else piece for index, piece in enumerate(pieces))


def policy(scripts: list[str], style: str) -> str:
    """What the browser allows the page: its own scripts and style, known by their hashes, and nothing from anywhere."""
    allowed = " ".join(_hash(text) for text in scripts)
    return (
        f"default-src 'none'; script-src {allowed}; style-src {_hash(style)}; img-src data: blob:; "
        "connect-src 'none'; base-uri 'none'; form-action 'none'"
    )


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode('utf-8')).digest()).decode('ascii')}'"


def as_json(values: Any) -> str:
    """JSON that no reader of HTML takes for an end of its script."""
    text = json.dumps(values, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _asset(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")
