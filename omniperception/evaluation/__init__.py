"""Evaluation of trained policies: trials in fixed worlds, gaits, films, and reports of them."""
