"""What several packages share: random streams, rotations, kernel launches, timing."""
