"""Files of recorded messages of ROS: .bag of ROS 1, .db3 and .mcap of ROS 2."""
