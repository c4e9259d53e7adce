"""Steppers: one file per family."""
