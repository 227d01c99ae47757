"""Number types of ROS's sensor_msgs/PointField."""

import numpy as np

TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy's names of the datatype constants INT8 to FLOAT64, without byte order."""
CODES = {np.dtype(kind): code for code, kind in TYPES.items()}
