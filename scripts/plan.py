"""Lists what a configuration consists of: `omniperception plan` in a checkout; `--help` explains it."""

import sys

from omniperception.commands import main

if __name__ == "__main__":
    main(["plan", *sys.argv[1:]])
