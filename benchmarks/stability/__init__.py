"""Where physics, LiDAR and learning hold and where they break: one module a subject, see scripts/stability.py."""
