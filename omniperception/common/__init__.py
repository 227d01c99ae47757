"""Code that several packages share: random streams, rotations, kernel launches, timing."""
