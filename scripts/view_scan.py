"""Draws what a LiDAR sees: `omniperception scan` in a checkout; `--help` explains it."""

import sys

from omniperception.commands import main

if __name__ == "__main__":
    main(["scan", *sys.argv[1:]])
