"""Figures of one recording: gait diagram, orientation, foot paths, servo angles, and the way on the ground."""
