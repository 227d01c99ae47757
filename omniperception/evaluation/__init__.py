"""Evaluation of trained policies: counted episodes with confidence intervals, baselines, pictures and videos."""

from omniperception.evaluation.episodes import run_episodes
from omniperception.evaluation.outcomes import Episodes
from omniperception.evaluation.statistics import wilson

__all__ = ["Episodes", "run_episodes", "wilson"]
