"""Names of policies and splits. Command lines read them before PyTorch is loaded."""

BASELINES = {
    "blind": "the run's policy as it acts before its first frame: it never has one",
    "stop": "the gait follows V_cmd, which falls to zero while the raw noisy cloud has something near ahead",
    "histogram": "the gait follows V_cmd + V_avoid, V_avoid by the run's avoidance controller from the raw noisy cloud"
    " by geometry: nearest return by sector, ground removed, velocities from successive frames, nothing learned",
    "ground_truth": "the gait follows what the run's navigation policy asks for, given the true places and velocities"
    " of all obstacles",
    "oracle": "the gait follows V_cmd + V_avoid, V_avoid by the run's avoidance controller from the true places and"
    " velocities of all obstacles",
}
"""Policies to compare with; the gait is the run's own, which then sees nothing, or that of another run."""

DRIVEN = ("stop", "histogram", "ground_truth", "oracle")
"""Those that drive a gait by its command."""

POLICIES = {
    "run": "the run's policy",
    **BASELINES,
    "exported": "the run's exported policy on what a robot measures: onnxruntime",
}
"""Policies to evaluate; the gait is the run's own, which then sees nothing, or that of `walker`."""

SPLITS = ("dev", "test")
