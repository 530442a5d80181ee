"""Live ROS 2: topics in, topics out. Only here is ROS imported: rclpy where it is, else cyclonedds."""
