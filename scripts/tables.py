"""Renders the results tables of the docs: `omniperception tables` in a checkout; `--help` explains it."""

import sys

from omniperception.commands import main

if __name__ == "__main__":
    main(["tables", *sys.argv[1:]])
