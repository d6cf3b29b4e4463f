#!/usr/bin/env python3
"""Where the method holds: several hundred cases at the extremes, each held against a reference that shares no code.

    ./with-fenicsx benchmarks/stability.py [--family NAME]... [--only TEXT]... [--again] [--jobs N] [--limit SECONDS]
    ./with-fenicsx benchmarks/stability.py --checkout PATH  # the same for another version, with its own command line
    ./with-fenicsx benchmarks/stability.py --report         # docs/stability.md from what has been measured

A case ends as right, refused, unstable, warned, wrong or unchecked (docs/stability.md says what each means), or as "not
there" where the version cannot express it. Each result is one line of results/stability/VERSION.jsonl. What is there is
not run again: a run that was stopped goes on where it was. The package's own results belong to its commit.
"""

from __future__ import annotations

import sys

from benchmarks.stability_map.command import main

if __name__ == "__main__":
    sys.exit(main(__doc__))
