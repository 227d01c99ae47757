"""Unitree's messages over DDS, the Livox packets, and clouds."""
