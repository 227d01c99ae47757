"""Obstacle avoidance: distances by sector, the risk of velocities, the avoidance velocity."""
