"""Spec files: YAML with line numbers, declared fields, and what all files describing a walk have in common."""
