"""Evaluates a run in fixed scenarios: `omniperception evaluate` in a checkout; `--help` explains it."""

import sys

from omniperception.commands import main

if __name__ == "__main__":
    main(["evaluate", *sys.argv[1:]])
