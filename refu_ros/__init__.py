"""The ROS 2 node and the commands; the only package that imports rclpy."""
