"""Gaits: where they break, which kicks they survive, when their feet are down, how they answer to commands."""
