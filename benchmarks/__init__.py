"""Studies and benchmarks of the framework; not part of the wheel. One harness, short studies, a script for each."""

import omniperception  # noqa: F401  before torch, whose threads it sets up
