"""Live ROS 2 nodes. Only this package imports ROS: rclpy if it is installed, else cyclonedds."""
