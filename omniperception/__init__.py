"""OmniPerception: learn collision avoidance for legged robots from raw LiDAR point clouds."""
