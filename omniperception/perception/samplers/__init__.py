"""Samplers: from a LiDAR frame to a fixed number of points."""
