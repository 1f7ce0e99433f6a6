"""Spec files: YAML that knows its lines, declared fields, and what every file about a walk has in common."""
