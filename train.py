"""Trains a policy: `omniperception train` in a checkout; `--help` explains it."""

import sys

from omniperception.commands import main

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])
