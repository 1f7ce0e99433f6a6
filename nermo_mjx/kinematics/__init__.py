"""Legs, spine and body as pure geometry: JAX functions that broadcast over leading axes and import only `robot`."""

__all__ = ["body", "leg", "spine"]
