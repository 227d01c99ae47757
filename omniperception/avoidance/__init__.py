"""What avoiding obstacles asks of the robot: true obstacles by sector, the risk of velocities, V_avoid."""
