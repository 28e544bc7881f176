"""A ROS 2 node, and recordings played to a ROS 2 graph, over DDS directly or with rclpy."""
