"""Looks at a gait: `omniperception gait` in a checkout; `--help` explains it."""

import sys

from omniperception.commands import main

if __name__ == "__main__":
    main(["gait", *sys.argv[1:]])
