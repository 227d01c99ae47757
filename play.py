"""Replays a run: `omniperception play` in a checkout; `--help` explains it."""

import sys

from omniperception.commands import main

if __name__ == "__main__":
    main(["play", *sys.argv[1:]])
