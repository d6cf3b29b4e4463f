"""Tutorials as notebooks, which the site offers for download: text, files to write, and commands in their order."""

from __future__ import annotations

import json
import re

from docs.making.tutorials import BLOCK, NAMED

HEAD = """*This notebook is made from a page of the documentation. Start Jupyter with the Python of dolfinx that has
this package (`pip install . jupyterlab`), in the folder of the clone: commands name files in `demos`. A tutorial may
read files that an earlier one has written.*
"""
LINK = re.compile(r"(?<!!)\[([^]\n]+)\]\((?!https?:)[^)\n]*\)")
PICTURE = re.compile(r"^!\[[^]]*\]\([^)]*\)\n", re.MULTILINE)


def cell(kind: str, text: str, number: int) -> dict[str, object]:
    """A cell; a number names it."""
    common = {"cell_type": kind, "id": f"cell-{number}", "metadata": {}, "source": text.strip("\n")}
    return common | ({} if kind == "markdown" else {"execution_count": None, "outputs": []})


def code(language: str, content: str) -> str | None:
    """A block as a notebook runs it; None if it is only shown."""
    name = NAMED.match(content)
    if name is not None and language in ("toml", "python", "text", "csv"):
        return f"%%writefile {name[1]}\n{content}"
    if language == "sh":
        return f"%%bash\nset -e\n{content.replace('./with-fenicsx ', '')}"
    return content if language == "python" else None


def notebook(page: str) -> str:
    """The notebook of a page, as JSON."""
    parts, end = [("markdown", HEAD)], 0
    for block in BLOCK.finditer(page):
        parts.append(("markdown", page[end : block.start()]))
        made = code(*block.groups())
        parts.append(("markdown", block[0]) if made is None else ("code", made))
        end = block.end()
    parts.append(("markdown", page[end:]))
    texts = (
        (kind, LINK.sub(r"\1", PICTURE.sub("", text)) if kind == "markdown" else text)
        for kind, text in parts
    )
    kept = [(kind, text) for kind, text in texts if text.strip()]
    whole = {
        "cells": [cell(kind, text, number) for number, (kind, text) in enumerate(kept)],
        "metadata": {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        },
        "nbformat": 4,
        "nbformat_minor": 5,
    }
    return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"
