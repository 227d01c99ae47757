"""Warp kernels of the toolkit.

The way of a ray: ``scan`` finds it in the scan table, ``search`` looks for the shapes that it may hit, ``geometry``
picks the intersection by kind of shape, and ``intersections``, ``mesh`` and ``heightfield`` compute it. Every kernel is
compiled on its own, the first time something needs it. ``env_offset`` is a launch's first environment, so that the
environments can be split over CPU threads. C++ is in header files.
"""
