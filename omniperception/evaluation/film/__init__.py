"""Pictures and videos of environments, without a graphics library."""
