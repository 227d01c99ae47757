"""The terms of the task: commands, observations, rewards, terminations, randomization."""
