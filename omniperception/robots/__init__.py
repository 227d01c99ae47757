"""Presets for robots from their files: what a file leaves open is guessed, and how the robot stands is looked at."""
