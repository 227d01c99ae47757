"""How fast and how exact the LiDAR toolkit is, beside the other ways of casting rays that are installed."""
