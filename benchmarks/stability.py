#!/usr/bin/env python3
"""Where the method holds: several hundred cases at the extremes, each held against a reference that shares no code.

    ./with-fenicsx benchmarks/stability.py [--family NAME]... [--only TEXT]... [--again] [--jobs N] [--limit SECONDS]
    ./with-fenicsx benchmarks/stability.py --report         # docs/reliability.md from what has been measured

A case ends as right, refused, unstable, warned, wrong or unchecked (docs/reliability.md says what each means).
Each result is one line of results/stability/VERSION.jsonl. What is there is not run again: a run that was stopped
goes on where it was. Results belong to the package as it was; another commit has benchmarks of its own.
"""

from __future__ import annotations

import sys

from benchmarks.stability_map.command import main

if __name__ == "__main__":
    sys.exit(main(__doc__))
