"""The learning task: commands, observations, rewards, terminations and randomization around a simulator."""
