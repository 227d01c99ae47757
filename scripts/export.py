"""Exports a policy: `omniperception export` in a checkout; `--help` explains it."""

import sys

from omniperception.commands import main

if __name__ == "__main__":
    main(["export", *sys.argv[1:]])
