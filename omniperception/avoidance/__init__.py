"""What avoiding obstacles asks of the robot: distances by sector, the risk of velocities, the avoidance velocity."""
