"""`python -m omniperception` is the console command."""

from omniperception.commands import main

if __name__ == "__main__":
    main()
