"""Warp kernels of the toolkit.

Every kernel is compiled on its own, the first time something needs it, for the shape kinds and the outputs that it
serves. ``env_offset`` is a launch's first environment, so that the environments can be split over CPU threads.
Quaternions arrive as (w, x, y, z).
"""
