"""Pictures of the experiments, in the form of the published figures."""
