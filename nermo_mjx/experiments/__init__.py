"""The published experiments: straight line, turning, balance, maze; and what the publication reports of them."""
