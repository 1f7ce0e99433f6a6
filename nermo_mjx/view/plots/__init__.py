"""Figures of one recording: gait diagram, orientation, foot paths, servo angles, and the path on the ground."""
