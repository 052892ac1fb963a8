"""MCAP files and ROS bags: the only code that knows how they are laid out."""
