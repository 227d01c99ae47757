"""Finds where a gait breaks: `omniperception robustness` in a checkout; `--help` explains it."""

import sys

from omniperception.commands import main

if __name__ == "__main__":
    main(["robustness", *sys.argv[1:]])
