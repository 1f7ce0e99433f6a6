"""Identification from logs: parameters of a robot from what it was commanded and what it measured."""
