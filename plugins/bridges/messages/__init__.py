"""Messages of ROS: their definitions, their bytes, and the fields that hold numbers."""
