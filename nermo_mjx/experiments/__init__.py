"""The published experiments: straight line, turning, balance, maze; and the published results."""
