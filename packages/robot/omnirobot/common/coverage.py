"""When a direction counts as looked into: numbers that training and the robot's runtime share."""

NUM_SECTORS = 36
"""Azimuth sectors around the sensor, yaw-aligned; sector 0 starts at -pi."""
BIN_DEG, NUM_BINS = 6.0, 30
"""Bins of elevation of each sector, in the levelled frame, from straight down to straight up."""
SHARE = 0.5
"""Least share of the bins, of those that are answered on flat ground, in which a covered sector has an answer."""
FRAMES = 2
"""Newest frames that count together: a lost one leaves nothing uncovered."""
SHUT_DEG, OPEN_DEG = 30.0, 60.0
"""Angle to an uncovered sector up to which a commanded velocity becomes 0, and from which it stays as it is."""
