"""Recordings of robots: MCAP, ROS 2 bags in SQLite and ROS 1 bags, with pictures, positions and magnetic fields."""
