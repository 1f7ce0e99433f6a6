"""Identification of parameters that the publication does not give, and its report."""
