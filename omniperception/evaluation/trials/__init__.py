"""Trials: whole episodes of numbered scenes, what is measured of them, and policies to compare with."""
