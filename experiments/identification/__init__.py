"""Stiffness and damping from measured motion."""
