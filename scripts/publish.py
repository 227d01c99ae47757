"""Makes a small run directory: `omniperception publish` in a checkout; `--help` explains it."""

import sys

from omniperception.commands import main

if __name__ == "__main__":
    main(["publish", *sys.argv[1:]])
