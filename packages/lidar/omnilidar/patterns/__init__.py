"""Scan patterns: the directions in which a sensor looks, as a function of time, and which of them are kept."""
