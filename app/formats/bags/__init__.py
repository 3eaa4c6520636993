"""Recordings of robots: MCAP and ROS 1 bags, with compressed pictures and positions."""
