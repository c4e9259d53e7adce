"""Robots: mechanisms from bodies and joints, beside MuJoCo and exudyn."""
