"""Figures of the experiments, in the form of the published ones."""
