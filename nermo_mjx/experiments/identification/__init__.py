"""Identification of what the publication does not give, and its report."""
