"""From a trained policy to a robot: its export, and a simulated robot on the robot's own wire to try it on."""
