"""Trains and evaluates perception variants: `omniperception ablate` in a checkout; `--help` explains it."""

import sys

from omniperception.commands import main

if __name__ == "__main__":
    main(["ablate", *sys.argv[1:]])
