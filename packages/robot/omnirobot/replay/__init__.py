"""An exported policy on recordings of robots."""
