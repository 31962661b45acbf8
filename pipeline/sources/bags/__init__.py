"""ROS bags and MCAP: containers, messages, and the images and sweeps in them."""
