"""Dry friction."""
