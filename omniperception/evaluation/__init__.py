"""Evaluation of trained policies: counted episodes with confidence intervals, baselines, pictures and videos."""

from omniperception.common.statistics import wilson
from omniperception.evaluation.episodes import run_episodes
from omniperception.evaluation.outcomes import Episodes

__all__ = ["Episodes", "run_episodes", "wilson"]
