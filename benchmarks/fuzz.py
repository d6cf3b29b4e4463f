#!/usr/bin/env python3
"""Random scenes over all keys, each held against a reference of its own: what nobody has thought of.

    ./with-fenicsx benchmarks/fuzz.py [--seed FIRST] [--count N] [--jobs N] [--limit SECONDS] [--again]
    ./with-fenicsx benchmarks/fuzz.py --only SEED      # prints the scene, runs and judges it

A seed makes a scene (`fuzzing/scenes.py`), which is run through the command line. What it leaves is held against what
must hold in every row, against a one-dimensional reference of its own where there is one (`fuzzing/references.py`), and
against another run that must come to the same (`fuzzing/relations.py`): in other units, of other kinematics, with other
solvers, on two ranks, stopped and resumed. Outcomes are those of benchmarks/stability. Each result is one line of
results/fuzz/VERSION.jsonl; what is there, of the same package, is not run again.
Seeds from 1,000,000 on are tubes that hardly change their volume, held against selective integration.
"""

from __future__ import annotations

import sys

from benchmarks.fuzzing.command import main

if __name__ == "__main__":
    sys.exit(main(__doc__))
